// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cmath>

#include "wiw/core/intrinsics.hpp"

namespace wiw::metrics {

/// How much a pixel counts. In an equirectangular image the rows near the poles show little of the sphere; kLatitude
/// weighs each row with the cosine of its latitude (rows cover 180 degrees), which makes the mean one over the sphere.
enum class Weighting { kUniform, kLatitude };

inline double row_weight(Weighting weighting, double row_centre, int height) {
  return weighting == Weighting::kUniform ? 1.0 : std::cos(kPi * (row_centre / height - 0.5));
}

}  // namespace wiw::metrics
