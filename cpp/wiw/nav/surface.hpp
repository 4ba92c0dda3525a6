// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <Eigen/Geometry>
#include <cstdint>
#include <vector>

#include "wiw/nav/detour_mesh.hpp"

namespace wiw::nav {

/// A connected part of the mesh.
struct Island {
  double area = 0;  // m2, on the surface
  int polygons = 0;
  Eigen::AlignedBox3f bounds;
};

/// The height-detailed walkable surface as plain triangles, with its connected parts.
struct Surface {
  std::vector<Island> islands;           // largest first
  std::vector<int> polygon_island;       // per polygon; -1 for polygons taken out of use
  std::vector<Eigen::Vector3f> corners;  // three a triangle
  std::vector<int> triangle_island;      // per triangle
  std::vector<double> cumulative_area;   // per triangle, sum up to and including it; triangles are sorted by island
  std::vector<Eigen::Vector3f> outline;  // two a boundary segment
  std::vector<int> outline_island;       // per boundary segment

  [[nodiscard]] double area() const { return cumulative_area.empty() ? 0 : cumulative_area.back(); }
};

/// Takes polygons of less than 1e-5 m2 out of use (Detour walks into them and gets stuck), flood-fills the islands
/// and collects the triangles.
Surface extract_surface(DetourMesh& mesh);

}  // namespace wiw::nav
