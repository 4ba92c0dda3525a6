// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <Eigen/Geometry>
#include <array>
#include <cstdint>
#include <map>
#include <tuple>

#include "wiw/scene/scene.hpp"

namespace wiw::scene {

/// A linear map as rotation x stretch: `rotation` is proper, `stretch` symmetric (with one negative eigenvalue for a
/// mirroring map).
struct RotationStretch {
  Eigen::Matrix3f rotation;
  Eigen::Matrix3f stretch;
};
RotationStretch split_rotation(const Eigen::Matrix3f& linear);

/// Copies meshes into a scene with an affine map applied to their vertices, each (mesh, map, material) once, so that
/// placements of the same thing share one mesh.
class MeshBaker {
 public:
  explicit MeshBaker(Scene& scene) : scene_(scene) {}

  /// `source` must outlive the baker. Returns the index into Scene::meshes.
  std::uint32_t bake(const Mesh& source, const Eigen::Affine3f& map, std::int32_t material);

 private:
  using Key = std::tuple<const Mesh*, std::array<float, 12>, std::int32_t>;
  Scene& scene_;
  std::map<Key, std::uint32_t> baked_;
};

}  // namespace wiw::scene
