// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstdint>

#include "wiw/core/image.hpp"
#include "wiw/metrics/weighting.hpp"

namespace wiw::metrics {

/// Structural similarity (Wang et al. 2004): Gaussian window 11x11 with sigma 1.5, K1 = 0.01, K2 = 0.03, each channel
/// for itself, mean over the windows that lie inside the image. With kLatitude the image is a panorama: windows wrap
/// around the seam, and each counts with the cosine of its centre's latitude. Throws ArgumentError if sizes differ or a
/// side is shorter than the window.
double ssim(ImageView<const std::uint8_t> a, ImageView<const std::uint8_t> b, double range, Weighting weighting);
double ssim(ImageView<const float> a, ImageView<const float> b, double range, Weighting weighting);

}  // namespace wiw::metrics
