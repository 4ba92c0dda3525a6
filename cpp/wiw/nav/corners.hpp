// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <utility>
#include <vector>

#include "wiw/nav/polygon_graph.hpp"

namespace wiw::nav {

/// A vertex around which shortest paths bend: the free space around it, a fan of polygons between two walls, spans more
/// than 180 degrees. Two fans that touch in one vertex are two corners, since nothing passes through the point between.
struct Corner {
  Point2 at;
  Point2 first, last;  // far ends of the walls, such that the fan runs counter-clockwise from first to last
  int vertex = -1;     // of the tile
  std::vector<std::pair<int, int>> fan;  // polygons counter-clockwise, each with the place of this vertex in it

  /// Whether a path that arrives from `from`, inside the fan, can bend here without getting longer than needed, that
  /// is, whether the fan leaves at least 180 degrees on one side of it.
  [[nodiscard]] bool is_taut(Point2 from) const { return orient(at, first, from) <= 0 || orient(at, from, last) <= 0; }
};

struct Corners {
  std::vector<Corner> list;
  std::vector<std::array<std::int32_t, kMaxSides>> of;  // per polygon and place: index into list, or -1
};

Corners find_corners(const PolygonGraph& graph);

}  // namespace wiw::nav
