// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <Eigen/Core>
#include <Eigen/Geometry>
#include <cstdint>
#include <span>
#include <vector>

#include "wiw/scene/scene.hpp"

namespace wiw::nav {

/// Heights of the floor that is drawn. Recast rounds floors up by as much as a cell (0.2 m at Habitat's settings), so a
/// camera put above the navigation mesh would hang higher than it should, by another amount in every scene.
class Ground {
 public:
  /// Level enough triangles of the scene, sorted into columns of 0.25 m, or wider ones where these would take too much
  /// memory; a scene without any has no ground anywhere.
  explicit Ground(const scene::Scene& scene) : Ground(scene::world_triangles(scene)) {}
  explicit Ground(const scene::TriangleSoup& soup);

  /// The highest surface at (x, z) from 0.45 m below to 0.1 m above the point, which lies on a navigation mesh:
  /// rounding and Recast's detail error lift that by up to two cells. The point's own y where there is no such surface,
  /// or where the point is not finite.
  [[nodiscard]] double height(const Eigen::Vector3d& point) const;

 private:
  using TriangleCorners = Eigen::Matrix3f;  // columns are corners

  [[nodiscard]] Eigen::Vector2i cell_of(double x, double z) const;
  [[nodiscard]] std::size_t slot(int column, int row) const;

  std::vector<TriangleCorners> triangles_;
  Eigen::Vector2f origin_ = Eigen::Vector2f::Zero();  // least x and z
  double cell_ = 0.25;                                // metres, at least
  Eigen::Vector2i cells_ = Eigen::Vector2i::Zero();
  std::vector<std::size_t> first_;      // per cell, and one more: where its entries begin
  std::vector<std::uint32_t> entries_;  // indices of triangles
};

}  // namespace wiw::nav
