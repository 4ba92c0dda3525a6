// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cmath>
#include <numbers>

#include "wiw/core/image.hpp"

namespace wiw {

constexpr double kPi = std::numbers::pi;
constexpr double radians(double degrees) { return degrees * kPi / 180.0; }
constexpr double degrees(double radians) { return radians * 180.0 / kPi; }

/// Pinhole camera with square pixels and the principal point at the image centre; `hfov` (radians) spans the outer
/// pixel edges, pixel centres lie at half integers. The ray of pixel (u, v) is ((u+.5-w/2)/f, -(v+.5-h/2)/f, -1).
struct Intrinsics {
  Size size;
  double hfov = kPi / 2;
  [[nodiscard]] double focal() const { return size.width / (2.0 * std::tan(hfov / 2.0)); }
};

}  // namespace wiw
