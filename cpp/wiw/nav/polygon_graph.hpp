// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <Eigen/Core>
#include <array>
#include <cstdint>
#include <vector>

#include "wiw/nav/detour_mesh.hpp"
#include "wiw/nav/plane.hpp"

namespace wiw::nav {

constexpr int kMaxSides = 6;

/// Convex, counter-clockwise in the (x, z) plane. Side k runs from corner k to corner k + 1.
struct Polygon {
  std::array<Point2, kMaxSides> at;
  std::array<std::int32_t, kMaxSides> next{};    // polygon across side k, -1 at a wall
  std::array<std::int32_t, kMaxSides> vertex{};  // index into the tile's vertices
  std::array<std::int8_t, kMaxSides> back{};     // which side of next[k] is side k
  std::int8_t sides = 0;

  [[nodiscard]] int after(int k) const { return k + 1 == sides ? 0 : k + 1; }
  [[nodiscard]] int before(int k) const { return k == 0 ? sides - 1 : k - 1; }
};

/// The polygons seen from above, joined side by side. Floors above each other stay apart, because one only gets from
/// polygon to polygon through a common side. Vertices have integer coordinates (Recast's voxel grid where the mesh lies
/// on one, else 2^-17 m), which makes orientation tests among them exact.
class PolygonGraph {
 public:
  PolygonGraph(const DetourMesh& mesh, const std::vector<int>& polygon_island);

  [[nodiscard]] const std::vector<Polygon>& polygons() const { return polygons_; }
  /// Metres per unit.
  [[nodiscard]] double scale() const { return scale_; }
  [[nodiscard]] Point2 to_plane(const Eigen::Vector3f& point) const {
    return {(point.x() - origin_x_) / scale_, (point.z() - origin_z_) / scale_};
  }
  [[nodiscard]] Eigen::Vector3f to_world(Point2 point, float height) const {
    return {static_cast<float>(origin_x_ + scale_ * point.x), height, static_cast<float>(origin_z_ + scale_ * point.y)};
  }
  /// `point`, at a wall or a hair outside because it is stored in single precision, moved so that it lies `margin`
  /// units inside the polygon (less where that is too narrow).
  [[nodiscard]] Point2 inside(int polygon, Point2 point, double margin) const;

 private:
  void choose_grid(const dtMeshTile& tile);
  [[nodiscard]] Polygon flatten(const dtMeshTile& tile, const dtPoly& poly) const;
  void join();

  std::vector<Polygon> polygons_;
  double origin_x_ = 0, origin_z_ = 0, scale_ = 1;
};

}  // namespace wiw::nav
