// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstdint>
#include <vector>

#include "wiw/scene/scene.hpp"

namespace wiw::render::cpu {

/// Places that lie close in memory for triangles that lie close in space: the place of each triangle. Scans list their
/// triangles in any order, and records in that order are read from all over the memory. Empty where the mesh is small,
/// or comes in an order that keeps neighbours together.
std::vector<std::uint32_t> spatial_order(const scene::Mesh& mesh);

}  // namespace wiw::render::cpu
