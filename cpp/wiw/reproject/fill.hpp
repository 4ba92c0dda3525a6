// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstdint>

#include "wiw/core/image.hpp"

namespace wiw::reproject {

/// Gives pixels without depth (kNothing) a guess.
///
/// Colour: a mean over the eight directions in the image, of what is met first in each, weighted with sqrt(depth) and
/// with a falling power of the distance. Both ends are averages over blocks of pixels, so that the guess is smooth:
/// where a whole room was hidden, nothing sharper is right on average.
///
/// Depth: along each row that of the farther of the gap's two ends, since what a moving camera uncovers lies behind
/// what hid it, or blended from both where they are about equally far; rows without any depth copy the nearest row that
/// has some.
///
/// `wraps`: the row's ends meet. An image without any depth turns black with depth 0.
void fill_holes(ImageView<std::uint8_t> color, ImageView<float> depth, bool wraps);

}  // namespace wiw::reproject
