// SPDX-License-Identifier: Apache-2.0
#include "wiw/metrics/ssim.hpp"

#include <algorithm>
#include <array>
#include <vector>

#include "wiw/metrics/image_pair.hpp"

namespace wiw::metrics {

namespace {

constexpr int kWindow = 11;
constexpr int kRadius = kWindow / 2;
constexpr double kSigma = 1.5;

std::array<float, kWindow> gaussian() {
  std::array<double, kWindow> weights{};
  double sum = 0;
  for (int i = 0; i < kWindow; ++i) {
    weights[i] = std::exp(-0.5 * (i - kRadius) * (i - kRadius) / (kSigma * kSigma));
    sum += weights[i];
  }
  std::array<float, kWindow> normalised{};
  for (int i = 0; i < kWindow; ++i) normalised[i] = static_cast<float>(weights[i] / sum);
  return normalised;
}

/// Both images as floats about the middle of the range (a shift changes no variance, but keeps squares small enough
/// for single precision), in rows widened by the wrapped columns where windows may wrap.
struct Shifted {
  std::vector<float> values;
  std::size_t stride;

  template <class T>
  Shifted(const ImageView<const T>& image, double range, bool wrap) {
    const auto channels = static_cast<std::size_t>(image.channels);
    const std::size_t count = static_cast<std::size_t>(image.size.width) * channels;
    const std::size_t margin = wrap ? kRadius * channels : 0;
    stride = count + 2 * margin;
    values.resize(stride * static_cast<std::size_t>(image.size.height));
    const auto middle = static_cast<float>(range / 2);
    for (int y = 0; y < image.size.height; ++y) {
      const T* from = image.row(y);
      float* to = values.data() + static_cast<std::size_t>(y) * stride;
      for (std::size_t i = 0; i < count; ++i) to[margin + i] = static_cast<float>(from[i]) - middle;
      std::copy(to + count, to + count + margin, to);
      std::copy(to + margin, to + 2 * margin, to + margin + count);
    }
  }
};

/// Local means of a, b, a^2 + b^2 and ab: all that the index needs.
constexpr int kMoments = 4;
using Rows = std::array<std::vector<float>, kMoments>;

void blur_down(const float* a, const float* b, std::size_t stride, const std::array<float, kWindow>& window,
               Rows& rows) {
  for (auto& row : rows) std::fill(row.begin(), row.end(), 0.0f);
  for (int k = 0; k < kWindow; ++k) {
    const float weight = window[k];
    const float* x = a + static_cast<std::size_t>(k) * stride;
    const float* y = b + static_cast<std::size_t>(k) * stride;
    float* __restrict mean_x = rows[0].data();
    float* __restrict mean_y = rows[1].data();
    float* __restrict squares = rows[2].data();
    float* __restrict product = rows[3].data();
    for (std::size_t i = 0; i < stride; ++i) {
      mean_x[i] += weight * x[i];
      mean_y[i] += weight * y[i];
      squares[i] += weight * (x[i] * x[i] + y[i] * y[i]);
      product[i] += weight * (x[i] * y[i]);
    }
  }
}

void blur_across(const std::vector<float>& row, int channels, const std::array<float, kWindow>& window,
                 std::vector<float>& blurred) {
  std::fill(blurred.begin(), blurred.end(), 0.0f);
  float* __restrict to = blurred.data();
  for (int k = 0; k < kWindow; ++k) {
    const float* from = row.data() + static_cast<std::size_t>(k * channels);
    const float weight = window[k];
    for (std::size_t i = 0; i < blurred.size(); ++i) to[i] += weight * from[i];
  }
}

double index_sum(const Rows& moments, double range) {
  const auto middle = static_cast<float>(range / 2);
  const auto c1 = static_cast<float>(0.01 * range * 0.01 * range);
  const auto c2 = static_cast<float>(0.03 * range * 0.03 * range);
  double sum = 0;
  for (std::size_t i = 0; i < moments[0].size(); ++i) {
    const float x = moments[0][i];
    const float y = moments[1][i];
    const float covariance = moments[3][i] - x * y;
    const float variances = moments[2][i] - x * x - y * y;
    const float mean_x = x + middle;
    const float mean_y = y + middle;
    const float above = (2 * mean_x * mean_y + c1) * (2 * covariance + c2);
    const float below = (mean_x * mean_x + mean_y * mean_y + c1) * (variances + c2);
    sum += static_cast<double>(above / below);
  }
  return sum;
}

template <class T>
double ssim_of(const ImageView<const T>& a, const ImageView<const T>& b, double range, Weighting weighting) {
  check_pair(a, b, kWindow);
  const bool wrap = weighting == Weighting::kLatitude;
  const Shifted x(a, range, wrap);
  const Shifted y(b, range, wrap);
  const auto window = gaussian();
  Rows down;
  Rows moments;
  for (auto& row : down) row.resize(x.stride);
  for (auto& row : moments) row.resize(x.stride - static_cast<std::size_t>((kWindow - 1) * a.channels));

  double sum = 0;
  double weights = 0;
  for (int top = 0; top + kWindow <= a.size.height; ++top) {
    const std::size_t offset = static_cast<std::size_t>(top) * x.stride;
    blur_down(x.values.data() + offset, y.values.data() + offset, x.stride, window, down);
    for (int m = 0; m < kMoments; ++m) blur_across(down[m], a.channels, window, moments[m]);
    const double weight = row_weight(weighting, top + kRadius + 0.5, a.size.height);
    sum += weight * index_sum(moments, range);
    weights += weight * static_cast<double>(moments[0].size());
  }
  if (std::isnan(sum)) throw ArgumentError("ssim: the images hold NaN");
  return sum / weights;
}

}  // namespace

double ssim(ImageView<const std::uint8_t> a, ImageView<const std::uint8_t> b, double range, Weighting weighting) {
  return ssim_of(a, b, range, weighting);
}

double ssim(ImageView<const float> a, ImageView<const float> b, double range, Weighting weighting) {
  return ssim_of(a, b, range, weighting);
}

}  // namespace wiw::metrics
