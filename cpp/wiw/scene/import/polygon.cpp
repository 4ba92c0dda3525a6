// SPDX-License-Identifier: Apache-2.0
#include "wiw/scene/import/polygon.hpp"

#include <Eigen/Geometry>
#include <algorithm>

namespace wiw::scene {
namespace {

struct PolygonCorner {
  std::uint32_t vertex;
  Eigen::Vector2d point;
};

/// Twice the signed area of a, b, c; positive counter-clockwise.
double turn(const Eigen::Vector2d& a, const Eigen::Vector2d& b, const Eigen::Vector2d& c) {
  return (b - a).x() * (c - a).y() - (b - a).y() * (c - a).x();
}

Eigen::Vector3d newell_normal(std::span<const unsigned> polygon, std::span<const Eigen::Vector3f> positions) {
  Eigen::Vector3d normal = Eigen::Vector3d::Zero();
  const Eigen::Vector3d origin = positions[polygon[0]].cast<double>();
  for (std::size_t i = 0; i < polygon.size(); ++i) {
    const Eigen::Vector3d a = positions[polygon[i]].cast<double>() - origin;
    const Eigen::Vector3d b = positions[polygon[(i + 1) % polygon.size()]].cast<double>() - origin;
    normal += a.cross(b);
  }
  return normal;
}

/// Drops the axis of the normal's largest component and keeps the polygon counter-clockwise.
std::vector<PolygonCorner> flatten(std::span<const unsigned> polygon, std::span<const Eigen::Vector3f> positions,
                                   const Eigen::Vector3d& normal) {
  Eigen::Index axis = 0;
  normal.cwiseAbs().maxCoeff(&axis);
  Eigen::Index u = (axis + 1) % 3;
  Eigen::Index v = (axis + 2) % 3;
  if (normal[axis] < 0.) std::swap(u, v);
  std::vector<PolygonCorner> corners;
  corners.reserve(polygon.size());
  for (const unsigned vertex : polygon) corners.push_back({vertex, {positions[vertex][u], positions[vertex][v]}});
  return corners;
}

bool is_convex(const std::vector<PolygonCorner>& corners) {
  const std::size_t n = corners.size();
  for (std::size_t i = 0; i < n; ++i) {
    if (turn(corners[i].point, corners[(i + 1) % n].point, corners[(i + 2) % n].point) < 0.) return false;
  }
  return true;
}

bool is_ear(const std::vector<PolygonCorner>& corners, std::size_t i) {
  const std::size_t n = corners.size();
  const Eigen::Vector2d& a = corners[(i + n - 1) % n].point;
  const Eigen::Vector2d& b = corners[i].point;
  const Eigen::Vector2d& c = corners[(i + 1) % n].point;
  if (turn(a, b, c) <= 0.) return false;
  return std::ranges::none_of(corners, [&](const PolygonCorner& corner) {
    const Eigen::Vector2d& p = corner.point;
    if (p == a || p == b || p == c) return false;
    return turn(a, b, p) >= 0. && turn(b, c, p) >= 0. && turn(c, a, p) >= 0.;
  });
}

void add(std::uint32_t a, std::uint32_t b, std::uint32_t c, std::span<const Eigen::Vector3f> positions,
         std::vector<Triangle>& triangles) {
  const Eigen::Vector3d origin = positions[a].cast<double>();
  const Eigen::Vector3d normal = (positions[b].cast<double>() - origin).cross(positions[c].cast<double>() - origin);
  if (normal.squaredNorm() > 0.) triangles.emplace_back(a, b, c);
}

}  // namespace

void triangulate(std::span<const unsigned> polygon, std::span<const Eigen::Vector3f> positions,
                 std::vector<Triangle>& triangles) {
  if (polygon.size() < 3) return;
  if (polygon.size() == 3) {
    add(polygon[0], polygon[1], polygon[2], positions, triangles);
    return;
  }
  const Eigen::Vector3d normal = newell_normal(polygon, positions);
  std::vector<PolygonCorner> corners = flatten(polygon, positions, normal);
  const bool convex = is_convex(corners);
  while (corners.size() > 3 && !convex) {
    std::size_t ear = 0;
    while (ear < corners.size() && !is_ear(corners, ear)) ++ear;
    if (ear == corners.size()) break;  // it crosses itself: what is left becomes a fan
    const std::size_t n = corners.size();
    add(corners[(ear + n - 1) % n].vertex, corners[ear].vertex, corners[(ear + 1) % n].vertex, positions, triangles);
    corners.erase(corners.begin() + static_cast<std::ptrdiff_t>(ear));
  }
  for (std::size_t i = 1; i + 1 < corners.size(); ++i) {
    add(corners[0].vertex, corners[i].vertex, corners[i + 1].vertex, positions, triangles);
  }
}

}  // namespace wiw::scene
