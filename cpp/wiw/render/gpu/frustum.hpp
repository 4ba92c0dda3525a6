// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <Eigen/Geometry>
#include <array>

#include "wiw/render/gpu/view.hpp"

namespace wiw::render::gpu {

/// The four sides and the near plane of a view; a point p is inside where normal . p + offset >= 0 for all of them.
class Frustum {
 public:
  explicit Frustum(const ViewBlock& view);

  /// The same planes in the coordinates of an instance.
  [[nodiscard]] Frustum in_instance(const Eigen::Affine3f& T_world_instance) const;

  /// False only if no point of the box is inside.
  [[nodiscard]] bool may_see(const Eigen::AlignedBox3f& box) const;

 private:
  Frustum() = default;
  std::array<Eigen::Vector3f, 5> normals_;
  std::array<float, 5> offsets_{};
};

}  // namespace wiw::render::gpu
