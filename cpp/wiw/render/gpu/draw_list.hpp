// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <vector>

#include "wiw/render/gpu/geometry.hpp"
#include "wiw/render/gpu/view.hpp"

namespace wiw::render::gpu {

/// One visible chunk of one instance.
struct Draw {
  float distance = 0;  // from the eye to the centre of the chunk's box, metres
  std::uint32_t instance = 0;
  std::uint32_t mesh = 0;
  std::uint32_t chunk = 0;
};

/// What a view may see: culled against its frustum, near before far so that hidden pixels are rejected before they are
/// shaded, cutouts last because they defeat that rejection.
class DrawList {
 public:
  /// `meshes` and `chunks` are those of build_geometry; instance i shows scene.instances[i].meshes at poses[i].
  void gather(const ViewBlock& view, const scene::Scene& scene, const std::vector<MeshRange>& meshes,
              const std::vector<MeshChunk>& chunks, const std::vector<Eigen::Affine3f>& poses);

  /// Everything, in no particular order.
  void gather_all(const scene::Scene& scene, const std::vector<MeshRange>& meshes);

  [[nodiscard]] const std::vector<Draw>& draws() const { return draws_; }

 private:
  std::vector<Draw> draws_;
};

}  // namespace wiw::render::gpu
