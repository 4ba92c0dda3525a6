// SPDX-License-Identifier: Apache-2.0
#include "wiw/metrics/psnr.hpp"

#include <algorithm>
#include <type_traits>

#include "wiw/metrics/image_pair.hpp"

namespace wiw::metrics {

namespace {

/// Squared error of one row; whole numbers for bytes (32768 squares fit 32 bits, so a row is summed in pieces).
template <class T>
double row_error(const T* a, const T* b, std::size_t count) {
  constexpr std::size_t kPiece = 32768;
  using Sum = std::conditional_t<std::is_integral_v<T>, std::uint32_t, double>;
  using Difference = std::conditional_t<std::is_integral_v<T>, std::int32_t, double>;
  double total = 0;
  for (std::size_t begin = 0; begin < count; begin += kPiece) {
    Sum sum = 0;
    for (std::size_t i = begin; i < std::min(count, begin + kPiece); ++i) {
      const Difference difference = static_cast<Difference>(a[i]) - static_cast<Difference>(b[i]);
      sum += static_cast<Sum>(difference * difference);
    }
    total += static_cast<double>(sum);
  }
  return total;
}

template <class T>
double psnr_of(const ImageView<const T>& a, const ImageView<const T>& b, double range, Weighting weighting) {
  check_pair(a, b, 1);
  const std::size_t count = static_cast<std::size_t>(a.size.width) * static_cast<std::size_t>(a.channels);
  double error = 0;
  double weights = 0;
  for (int y = 0; y < a.size.height; ++y) {
    const double weight = row_weight(weighting, y + 0.5, a.size.height);
    error += weight * row_error(a.row(y), b.row(y), count);
    weights += weight * static_cast<double>(count);
  }
  const double relative = error / weights / (range * range);
  if (std::isnan(relative)) throw ArgumentError("psnr: the images hold NaN");
  return relative == 0 ? kPsnrCap : std::min(kPsnrCap, -10 * std::log10(relative));
}

}  // namespace

double psnr(ImageView<const std::uint8_t> a, ImageView<const std::uint8_t> b, double range, Weighting weighting) {
  return psnr_of(a, b, range, weighting);
}

double psnr(ImageView<const float> a, ImageView<const float> b, double range, Weighting weighting) {
  return psnr_of(a, b, range, weighting);
}

}  // namespace wiw::metrics
