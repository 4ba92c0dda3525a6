// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <Eigen/Core>
#include <vector>

#include "wiw/nav/detour_mesh.hpp"

namespace wiw::nav {

/// Walks from a projected start towards `end` over the surface; `polygon_island` keeps it on the start's island.
Eigen::Vector3f walk(const DetourMesh& mesh, const std::vector<int>& polygon_island, const Projection& start,
                     const Eigen::Vector3f& end, bool sliding);

}  // namespace wiw::nav
