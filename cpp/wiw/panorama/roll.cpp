// SPDX-License-Identifier: Apache-2.0
#include "wiw/panorama/roll.hpp"

#include <algorithm>
#include <cmath>
#include <type_traits>

#include "wiw/core/error.hpp"

namespace wiw::panorama {

namespace {

std::uint8_t mix(std::uint8_t a, std::uint8_t b, double fraction) {
  return static_cast<std::uint8_t>(std::lround(a + fraction * (static_cast<double>(b) - a)));
}

float mix(float a, float b, double fraction) { return a + static_cast<float>(fraction) * (b - a); }

/// Columns move to the right by `columns`.
template <class T>
void roll_row(const T* row, int width, int channels, int columns, T* out) {
  const std::ptrdiff_t cut = static_cast<std::ptrdiff_t>(width - columns) * channels;
  std::copy(row, row + cut, out + static_cast<std::ptrdiff_t>(columns) * channels);
  std::copy(row + cut, row + static_cast<std::ptrdiff_t>(width) * channels, out);
}

/// out[x] = blend of columns x - columns and x - columns - 1 of the source.
template <class T>
void blend_row(const T* row, int width, int channels, int columns, double fraction, T* out) {
  for (int x = 0; x < width; ++x) {
    const int near = (x - columns + width) % width;
    const int far = (near - 1 + width) % width;
    for (int c = 0; c < channels; ++c) {
      out[x * channels + c] = mix(row[near * channels + c], row[far * channels + c], fraction);
    }
  }
}

}  // namespace

template <class T>
void rotate(ImageView<const T> panorama, double yaw, Interpolation interpolation, T* out) {
  check_panorama_size(panorama.size);
  if (!std::isfinite(yaw)) throw ArgumentError("yaw_deg: expected a finite angle");
  const int width = panorama.size.width;
  const double turns = yaw / (2.0 * kPi);
  const double exact = (turns - std::floor(turns)) * width;
  const double nearest = std::round(exact);
  const bool whole = interpolation == Interpolation::kNearest || std::abs(exact - nearest) < 1e-6;
  const int columns = static_cast<int>(whole ? nearest : std::floor(exact)) % width;
  const std::size_t stride = static_cast<std::size_t>(width) * static_cast<std::size_t>(panorama.channels);
  for (int y = 0; y < panorama.size.height; ++y, out += stride) {
    if (whole) {
      roll_row(panorama.row(y), width, panorama.channels, columns, out);
    } else if constexpr (std::is_same_v<T, std::uint32_t>) {
      throw ArgumentError(
          "uint32 images hold ids, which cannot be blended: turn by whole columns or pass "
          "interpolation=\"nearest\"");
    } else {
      blend_row(panorama.row(y), width, panorama.channels, columns, exact - std::floor(exact), out);
    }
  }
}

template void rotate(ImageView<const std::uint8_t>, double, Interpolation, std::uint8_t*);
template void rotate(ImageView<const float>, double, Interpolation, float*);
template void rotate(ImageView<const std::uint32_t>, double, Interpolation, std::uint32_t*);

}  // namespace wiw::panorama
