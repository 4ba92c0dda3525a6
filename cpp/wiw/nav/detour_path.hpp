// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <Eigen/Core>
#include <vector>

#include "wiw/nav/detour_mesh.hpp"

namespace wiw::nav {

/// Detour's own path between two projected points: A* over polygons, then a taut string through the corridor found.
/// With `capped` it stops at 256 polygons and 2048 nodes, where Habitat reports "unreachable". Empty if it stopped.
std::vector<Eigen::Vector3f> detour_path(const DetourMesh& mesh, const MeshPoint& start, const MeshPoint& end,
                                         bool capped);

/// Sum of the 3D segment lengths.
double polyline_length(const std::vector<Eigen::Vector3f>& points);

}  // namespace wiw::nav
