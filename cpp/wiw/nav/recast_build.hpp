// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <Eigen/Core>
#include <cstdint>
#include <span>
#include <vector>

#include "wiw/nav/settings.hpp"

namespace wiw::nav {

/// Polygon flags and area of Habitat's files.
enum PolygonFlag : unsigned short { kWalkable = 1, kDoor = 2, kDisabled = 4, kOffIsland = 8 };
constexpr unsigned char kGroundArea = 0;

/// Voxelises the triangles and traces one Detour tile around what an agent of these settings can stand on.
/// Throws ArgumentError if nothing is walkable or the scene does not fit one tile; the message says what to change.
std::vector<std::uint8_t> build_tile(std::span<const Eigen::Vector3f> vertices,
                                     std::span<const Eigen::Matrix<std::uint32_t, 3, 1>> triangles,
                                     const NavMeshSettings& settings);

}  // namespace wiw::nav
