// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstdint>
#include <vector>

#include "wiw/core/image.hpp"
#include "wiw/panorama/group.hpp"

namespace wiw::panorama {

/// One group for every sixteen of a table's pixels, the rest left over. `texel` is BilinearTable's; `source` has three
/// channels of a byte each.
std::vector<BlockGroup> find_groups(const std::vector<std::uint32_t>& texel, const Size& source);

}  // namespace wiw::panorama
