// SPDX-License-Identifier: Apache-2.0
#include "wiw/render/cpu/cpu_renderer.hpp"

#include <algorithm>
#include <mutex>
#include <optional>

#if defined(__x86_64__)
#include <xmmintrin.h>
#endif

#include "wiw/core/error.hpp"
#include "wiw/core/thread_pool.hpp"
#include "wiw/render/cpu/embree_scene.hpp"
#include "wiw/render/cpu/ray_tables.hpp"
#include "wiw/render/request.hpp"

namespace wiw::render {

namespace {

using namespace cpu;

/// A tile is one unit of work: whole packets for every instruction set, small enough to balance two cores at the end
/// of a frame, and its triangles and texels stay in the second-level cache.
constexpr Size kTile{32, 64};

/// Denormals as zero while kernels run: traversal meets many, and each would cost over a hundred cycles.
class FlushDenormals {
 public:
#if defined(__x86_64__)
  FlushDenormals() : saved_(_mm_getcsr()) { _mm_setcsr(saved_ | 0x8040u); }  // FTZ | DAZ
  ~FlushDenormals() { _mm_setcsr(saved_); }

 private:
  unsigned saved_;
#endif
};

TileKernel kernel_for(Isa isa, bool gather) {
#if defined(__x86_64__)
  if (isa == Isa::kAvx512) return gather ? render_tile_avx512_gather : render_tile_avx512;
  if (isa == Isa::kAvx2) return render_tile_avx2;
#endif
  return render_tile_scalar;
}

ImageTargets image_of(const RenderTargets& targets, Size size, std::size_t index) {
  const std::size_t first = index * size.pixels();
  ImageTargets image{};
  image.height = size.height;
  image.width = size.width;
  if (targets.color != nullptr) image.color = targets.color + 3 * first;
  if (targets.depth != nullptr) image.depth = targets.depth + first;
  if (targets.instance != nullptr) image.instance = targets.instance + first;
  return image;
}

class CpuRenderer final : public Renderer {
 public:
  CpuRenderer(scene::ScenePtr scene, const RenderOptions& options, Isa isa, bool gather)
      : scene_(std::move(scene)),
        options_(options),
        isa_(isa),
        kernel_(kernel_for(isa, gather)),
        shading_(*scene_),
        embree_(*scene_, shading_, isa) {
    shading_.describe(kernel_scene_);
    for (const InstanceMesh& part : shading_.parts())
      last_.push_back(scene_->instances[part.instance].T_world_instance.matrix());
  }

  void render(std::span<const Pose> T_world_camera, const Camera& camera, const RenderTargets& targets) override {
    check_request(T_world_camera, camera);
    if (targets.color == nullptr && targets.depth == nullptr && targets.instance == nullptr) return;
    const std::scoped_lock lock(mutex_);
    if (!tables_ || !tables_->fits(camera)) tables_.emplace(camera, options_.samples);
    kernel_scene_.fixed = embree_.fixed();
    kernel_scene_.moved = embree_.moved();
    const int across = (camera.size.width + kTile.width - 1) / kTile.width;
    const int down = (camera.size.height + kTile.height - 1) / kTile.height;
    const auto per_view = static_cast<std::size_t>(across) * static_cast<std::size_t>(down);
    parallel_for(T_world_camera.size() * per_view, [&](std::size_t i) {
      const FlushDenormals flush;
      const std::size_t index = i / per_view;
      const auto number = static_cast<int>(i % per_view);
      Tile tile{number % across * kTile.width, number / across * kTile.height, 0, 0};
      tile.width = std::min(kTile.width, camera.size.width - tile.x);
      tile.height = std::min(kTile.height, camera.size.height - tile.y);
      kernel_(kernel_scene_, tables_->view(T_world_camera[index]), image_of(targets, camera.size, index), tile);
    });
  }

  void set_poses(std::span<const std::uint32_t> ids, std::span<const Eigen::Affine3f> poses) override {
    check_poses(*scene_, ids, poses);
    const std::scoped_lock lock(mutex_);
    const auto parts = shading_.parts();
    std::vector<EmbreeScene::MeshPlacement> moved;
    for (std::size_t i = 0; i < ids.size(); ++i) {
      const std::uint32_t index = ids[i] - 1;
      // Parts are ordered by instance.
      auto part = std::lower_bound(parts.begin(), parts.end(), index,
                                   [](const InstanceMesh& p, std::uint32_t value) { return p.instance < value; });
      for (; part != parts.end() && part->instance == index; ++part) {
        const auto number = static_cast<std::size_t>(part - parts.begin());
        if (last_[number] == poses[i].matrix()) continue;
        last_[number] = poses[i].matrix();
        shading_.place(number, poses[i]);
        moved.push_back({number, &poses[i]});
      }
    }
    embree_.move(moved);
  }

  [[nodiscard]] const scene::Scene& scene() const override { return *scene_; }
  [[nodiscard]] std::string description() const override {
    return "cpu (Embree " + embree_.version() + ", " + isa_name(isa_) + ")";
  }

 private:
  scene::ScenePtr scene_;
  RenderOptions options_;
  Isa isa_;
  TileKernel kernel_;
  ShadingScene shading_;
  EmbreeScene embree_;
  KernelScene kernel_scene_{};
  std::vector<Eigen::Matrix4f> last_;  // poses of the parts
  std::optional<RayTables> tables_;
  std::mutex mutex_;
};

}  // namespace

std::shared_ptr<Renderer> make_cpu_renderer(scene::ScenePtr scene, const RenderOptions& options, Isa isa, bool gather) {
  check_options(options);
  if (isa > native_isa()) {
    throw BackendError("render: this processor has no " + isa_name(isa) + ", only " + isa_name(native_isa()));
  }
  scene->validate();
  if (scene->triangle_count() == 0) throw ArgumentError("render: scene '" + scene->name + "' has no triangles");
  return std::make_shared<CpuRenderer>(std::move(scene), options, isa, gather);
}

}  // namespace wiw::render
