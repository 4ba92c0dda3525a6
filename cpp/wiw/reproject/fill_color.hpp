// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstdint>

#include "wiw/core/image.hpp"

namespace wiw::reproject {

/// The colour half of fill_holes; at least one pixel must have depth.
void fill_color(ImageView<std::uint8_t> color, ImageView<const float> depth, bool wraps);

}  // namespace wiw::reproject
