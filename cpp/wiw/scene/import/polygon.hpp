// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <Eigen/Core>
#include <cstdint>
#include <span>
#include <vector>

#include "wiw/scene/triangle.hpp"

namespace wiw::scene {

/// Appends the triangles of a simple polygon, given as indices into `positions` in order. Convex polygons become a fan,
/// others are cut ear by ear in the plane that their Newell normal names. Triangles without area are left out.
void triangulate(std::span<const unsigned> polygon, std::span<const Eigen::Vector3f> positions,
                 std::vector<Triangle>& triangles);

}  // namespace wiw::scene
