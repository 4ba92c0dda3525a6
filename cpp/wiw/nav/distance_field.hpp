// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <memory>
#include <span>

#include "wiw/nav/nav_mesh.hpp"

namespace wiw::nav {

/// Exact distance to the nearest of fixed goals, for callers that ask at every step: some ten microseconds a point.
class DistanceField {
 public:
  /// Throws NavigationError naming the first goal off the mesh, ArgumentError if there is none.
  DistanceField(std::shared_ptr<const NavMesh> mesh, std::span<const Eigen::Vector3f> goals);
  [[nodiscard]] Distance distance(const Eigen::Vector3f& point) const;

 private:
  std::shared_ptr<const NavMesh> mesh_;
  std::vector<int> islands_;  // that hold a goal
  std::unique_ptr<const GoalSearch> search_;
};

}  // namespace wiw::nav
