// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstdint>

#include "wiw/core/image.hpp"

namespace wiw::reproject {

/// Gives pixels without depth (kNothing) the colour and depth of the background beside them: along each row, of the
/// farther of the two ends of the gap, or blended from both where they are about equally far; rows without any depth
/// copy the nearest row that has some. What a moving camera uncovers lies behind what hid it. `wraps`: the row's ends
/// meet. An image without any depth turns black with depth 0.
void fill_holes(ImageView<std::uint8_t> color, ImageView<float> depth, bool wraps);

}  // namespace wiw::reproject
