// SPDX-License-Identifier: Apache-2.0
#include "wiw/nav/corners.hpp"

#include <cmath>
#include <numbers>

namespace wiw::nav {
namespace {

double angle_between(Point2 a, Point2 b) { return std::atan2(cross(a, b), dot(a, b)); }

/// Walks the fan counter-clockwise from the wall at side `place` and returns (polygon, place) of its members.
std::vector<std::pair<int, int>> walk_fan(const PolygonGraph& graph, int polygon, int place) {
  std::vector<std::pair<int, int>> members;
  const std::size_t limit = graph.polygons().size();
  while (polygon >= 0 && members.size() <= limit) {
    members.emplace_back(polygon, place);
    const Polygon& p = graph.polygons()[polygon];
    const int side = p.before(place);
    polygon = p.next[side];
    place = p.back[side];
  }
  return members;
}

double fan_angle(const PolygonGraph& graph, const std::vector<std::pair<int, int>>& members) {
  double angle = 0;
  for (const auto& [polygon, place] : members) {
    const Polygon& p = graph.polygons()[polygon];
    angle += angle_between(p.at[p.after(place)] - p.at[place], p.at[p.before(place)] - p.at[place]);
  }
  return angle;
}

}  // namespace

Corners find_corners(const PolygonGraph& graph) {
  Corners corners;
  std::array<std::int32_t, kMaxSides> none;
  none.fill(-1);
  corners.of.assign(graph.polygons().size(), none);
  for (int i = 0; i < static_cast<int>(graph.polygons().size()); ++i) {
    const Polygon& polygon = graph.polygons()[i];
    for (int k = 0; k < polygon.sides; ++k) {
      if (polygon.next[k] >= 0) continue;
      const auto members = walk_fan(graph, i, k);
      const Polygon& end = graph.polygons()[members.back().first];
      const Point2 last = end.at[end.before(members.back().second)];
      Corner corner{polygon.at[k], polygon.at[polygon.after(k)], last, polygon.vertex[k], members};
      // The sum tells a full turn from none; the exact test tells a bend from a straight wall.
      const double angle = fan_angle(graph, members);
      const bool straight = orient(corner.at, corner.first, corner.last) == 0 && angle < 1.5 * std::numbers::pi;
      if (angle <= std::numbers::pi - 1e-9 || straight) continue;
      for (const auto& [member, place] : members) {
        corners.of[member][place] = static_cast<std::int32_t>(corners.list.size());
      }
      corners.list.push_back(std::move(corner));
    }
  }
  return corners;
}

}  // namespace wiw::nav
