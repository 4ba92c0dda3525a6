// SPDX-License-Identifier: Apache-2.0
// Slow twins in double precision: one pixel at a time, straight from the definitions.
#pragma once

#include <cmath>
#include <vector>

#include "wiw/core/rng.hpp"
#include "wiw/panorama/projection.hpp"

namespace twin {

using namespace wiw;
using namespace wiw::panorama;

template <class T>
std::vector<T> noise(const Size& size, int channels, std::uint64_t seed) {
  std::vector<T> image(size.pixels() * static_cast<std::size_t>(channels));
  Rng rng(seed);
  for (T& value : image) value = static_cast<T>(rng.below(256));
  return image;
}

/// Texel of a panorama at any integer coordinates: crossing a pole arrives half a turn away.
template <class T>
double texel(ImageView<const T> pano, int row, int column, int channel) {
  const int height = pano.size.height;
  const int width = pano.size.width;
  if (row < 0) {
    row = -1 - row;
    column += width / 2;
  } else if (row >= height) {
    row = 2 * height - 1 - row;
    column += width / 2;
  }
  return static_cast<double>(pano.at(row, ((column % width) + width) % width)[channel]);
}

template <class T>
double sample(ImageView<const T> pano, const Eigen::Vector3d& direction, int channel) {
  const double longitude = std::atan2(direction.x(), -direction.z());
  const double latitude = std::asin(direction.normalized().y());
  const double x = (longitude / (2 * kPi) + 0.5) * pano.size.width - 0.5;
  const double y = (0.5 - latitude / kPi) * pano.size.height - 0.5;
  const int column = static_cast<int>(std::floor(x));
  const int row = static_cast<int>(std::floor(y));
  const double fx = x - column;
  const double fy = y - row;
  return (1 - fy) * ((1 - fx) * texel(pano, row, column, channel) + fx * texel(pano, row, column + 1, channel)) +
         fy * ((1 - fx) * texel(pano, row + 1, column, channel) + fx * texel(pano, row + 1, column + 1, channel));
}

/// Ray of pixel (u, v) of a view turned left by yaw after it was tilted up by pitch.
inline Eigen::Vector3d ray(int u, int v, const PerspectiveView& view, double yaw) {
  const double focal = view.size.width / (2 * std::tan(view.hfov / 2));
  const Eigen::Vector3d local((u + 0.5 - view.size.width / 2.0) / focal, -(v + 0.5 - view.size.height / 2.0) / focal,
                              -1);
  const double cp = std::cos(view.pitch);
  const double sp = std::sin(view.pitch);
  const Eigen::Vector3d tilted(local.x(), cp * local.y() - sp * local.z(), sp * local.y() + cp * local.z());
  const double cy = std::cos(yaw);
  const double sy = std::sin(yaw);
  return {cy * tilted.x() + sy * tilted.z(), tilted.y(), -sy * tilted.x() + cy * tilted.z()};
}

}  // namespace twin
