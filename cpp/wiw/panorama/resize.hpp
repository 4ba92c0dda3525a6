// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstdint>

#include "wiw/core/image.hpp"

namespace wiw::panorama {

/// Throws ArgumentError unless `size` is not empty and neither of its sides longer than the source's.
void check_resize(const Size& source, const Size& size);

/// Shrinks an image to `size` (neither side may grow): each output pixel is the exact mean of the source over its
/// area, partly covered pixels counting by their covered share. T is uint8 (rounded) or float.
template <class T>
void resize_area(ImageView<const T> source, const Size& size, T* out);

}  // namespace wiw::panorama
