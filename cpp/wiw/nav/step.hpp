// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <Eigen/Core>
#include <vector>

#include "wiw/nav/detour_mesh.hpp"
#include "wiw/nav/polygon_graph.hpp"

namespace wiw::nav {

/// Where a straight line over the mesh ends: at its target or at the first wall.
struct Stop {
  double fraction = 0;  // of the line
  int polygon = -1;
};
Stop walk_straight(const PolygonGraph& graph, int polygon, Point2 start, Point2 end);

/// Walks from a projected start towards `end` over the surface; `polygon_island` keeps it on the start's island.
Eigen::Vector3f walk(const DetourMesh& mesh, const PolygonGraph& graph, const std::vector<int>& polygon_island,
                     const MeshPoint& start, const Eigen::Vector3f& end, bool sliding);

}  // namespace wiw::nav
