// SPDX-License-Identifier: Apache-2.0
#pragma once

#include "wiw/panorama/projection.hpp"

namespace wiw::panorama {

/// The panorama seen after a turn to the left by `yaw` radians, [H, W, C] -> [H, W, C]. Whole columns are copied (22.5
/// degrees are exactly W/16 columns to the right); otherwise neighbouring columns are blended, or the nearest taken.
/// T is uint8, float or uint32; uint32 takes whole columns or kNearest.
template <class T>
void rotate(ImageView<const T> panorama, double yaw, Interpolation interpolation, T* out);

}  // namespace wiw::panorama
