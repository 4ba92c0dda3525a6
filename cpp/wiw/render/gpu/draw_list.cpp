// SPDX-License-Identifier: Apache-2.0
#include "wiw/render/gpu/draw_list.hpp"

#include <algorithm>
#include <tuple>

#include "wiw/render/gpu/frustum.hpp"

namespace wiw::render::gpu {

void DrawList::gather(const ViewBlock& view, const scene::Scene& scene, const std::vector<MeshRange>& meshes,
                      const std::vector<MeshChunk>& chunks, const std::vector<Eigen::Affine3f>& poses) {
  draws_.clear();
  const Frustum frustum(view);
  const Eigen::Vector3f eye = view.eye.head<3>();
  for (std::uint32_t i = 0; i < poses.size(); ++i) {
    const Frustum local = frustum.in_instance(poses[i]);
    for (const std::uint32_t mesh : scene.instances[i].meshes) {
      const MeshRange& range = meshes[mesh];
      if (range.chunk_count == 0 || !local.may_see(range.box)) continue;
      for (std::size_t k = range.first_chunk; k < range.first_chunk + range.chunk_count; ++k) {
        const MeshChunk& chunk = chunks[k];
        if (range.chunk_count > 1 && !local.may_see(chunk.box)) continue;
        const float distance = (poses[i] * chunk.box.center() - eye).norm();
        draws_.push_back({distance, i, mesh, static_cast<std::uint32_t>(k)});
      }
    }
  }
  std::ranges::sort(draws_, {}, [&](const Draw& draw) {
    return std::tuple((meshes[draw.mesh].appearance & kCutout) != 0, draw.distance, draw.instance, draw.chunk);
  });
}

void DrawList::gather_all(const scene::Scene& scene, const std::vector<MeshRange>& meshes) {
  draws_.clear();
  for (std::uint32_t i = 0; i < scene.instances.size(); ++i) {
    for (const std::uint32_t mesh : scene.instances[i].meshes) {
      const MeshRange& range = meshes[mesh];
      for (std::size_t k = range.first_chunk; k < range.first_chunk + range.chunk_count; ++k) {
        draws_.push_back({0.f, i, mesh, static_cast<std::uint32_t>(k)});
      }
    }
  }
}

}  // namespace wiw::render::gpu
