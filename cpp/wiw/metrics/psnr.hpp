// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstdint>

#include "wiw/core/image.hpp"
#include "wiw/metrics/weighting.hpp"

namespace wiw::metrics {

/// Images that agree have no error to measure; they get this value, so that means stay finite.
constexpr double kPsnrCap = 100.0;

/// Peak signal-to-noise ratio 10 log10(range^2 / MSE) in dB over all pixels and channels, at most kPsnrCap. With
/// kLatitude the squared error is weighted by row (WS-PSNR, Sun et al. 2017). Throws ArgumentError if sizes differ.
double psnr(ImageView<const std::uint8_t> a, ImageView<const std::uint8_t> b, double range, Weighting weighting);
double psnr(ImageView<const float> a, ImageView<const float> b, double range, Weighting weighting);

}  // namespace wiw::metrics
