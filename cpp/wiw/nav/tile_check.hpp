// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstdint>
#include <span>
#include <string>

namespace wiw::nav {

/// Detour follows the indices of a tile without looking. Empty if every array, index and coordinate of the tile is in
/// range, otherwise what is wrong, as the second half of a sentence.
std::string find_tile_fault(std::span<const std::uint8_t> tile);

}  // namespace wiw::nav
