// SPDX-License-Identifier: Apache-2.0
#include "wiw/panorama/projection.hpp"

#include <Eigen/Geometry>
#include <algorithm>
#include <cmath>
#include <string>

#include "wiw/core/error.hpp"

namespace wiw::panorama {

namespace {

/// Tangents per pixel along both axes.
Eigen::Vector2d pixel_pitch(const PerspectiveView& view) {
  const double tangent = 2.0 * std::tan(view.hfov / 2.0);
  if (view.convention == FovConvention::kPixelEdges) {
    return Eigen::Vector2d::Constant(tangent / view.size.width);
  }
  // A single row or column looks along the axis of its pixel centre, so its pitch does not matter.
  return {tangent / std::max(1, view.size.width - 1), tangent / std::max(1, view.size.height - 1)};
}

}  // namespace

Eigen::Vector3d pixel_direction(double x, double y, const Size& panorama) {
  const double longitude = (x + 0.5) / panorama.width * 2.0 * kPi - kPi;
  const double latitude = kPi / 2 - (y + 0.5) / panorama.height * kPi;
  return {std::sin(longitude) * std::cos(latitude), std::sin(latitude), -std::cos(longitude) * std::cos(latitude)};
}

Eigen::Vector2d direction_pixel(const Eigen::Vector3d& direction, const Size& panorama) {
  const double longitude = std::atan2(direction.x(), -direction.z());
  const double latitude = std::atan2(direction.y(), std::hypot(direction.x(), direction.z()));
  double x = (longitude + kPi) / (2.0 * kPi) * panorama.width - 0.5;
  if (x >= panorama.width - 0.5) x -= panorama.width;
  return {x, (kPi / 2 - latitude) / kPi * panorama.height - 0.5};
}

Eigen::Vector3d view_ray(int u, int v, const PerspectiveView& view) {
  const Eigen::Vector2d pitch = pixel_pitch(view);
  return {(u + 0.5 - view.size.width / 2.0) * pitch.x(), -(v + 0.5 - view.size.height / 2.0) * pitch.y(), -1.0};
}

Coordinates perspective_coordinates(const Size& panorama, const PerspectiveView& view) {
  check_panorama_size(panorama);
  check_view(view);
  const Eigen::Matrix3d rotation = Eigen::AngleAxisd(view.pitch, Eigen::Vector3d::UnitX()).toRotationMatrix();
  Coordinates coordinates;
  coordinates.x.reserve(view.size.pixels());
  coordinates.y.reserve(view.size.pixels());
  for (int v = 0; v < view.size.height; ++v) {
    for (int u = 0; u < view.size.width; ++u) {
      const Eigen::Vector2d pixel = direction_pixel(rotation * view_ray(u, v, view), panorama);
      coordinates.x.push_back(pixel.x());
      coordinates.y.push_back(pixel.y());
    }
  }
  return coordinates;
}

void directions(const Size& panorama, float* out) {
  check_panorama_size(panorama);
  for (int y = 0; y < panorama.height; ++y) {
    for (int x = 0; x < panorama.width; ++x, out += 3) {
      const Eigen::Vector3d direction = pixel_direction(x, y, panorama);
      std::transform(direction.begin(), direction.end(), out, [](double v) { return static_cast<float>(v); });
    }
  }
}

void check_panorama_size(const Size& panorama) {
  if (panorama.height < 1 || panorama.width < 2 || panorama.height > 32767 || panorama.width > 32766 ||
      panorama.width % 2 != 0 || panorama.pixels() > (std::size_t{1} << 29)) {
    throw ArgumentError(
        "panorama size: expected 1 to 32767 rows, an even number of columns from 2 to 32766 and at most 2^29 pixels, "
        "got " +
        std::to_string(panorama.height) + " x " + std::to_string(panorama.width));
  }
}

void check_view(const PerspectiveView& view) {
  if (view.size.height < 1 || view.size.width < 1 || view.size.height > 32767 || view.size.width > 32767) {
    throw ArgumentError("view size: expected (H, W) from 1 to 32767, got " + std::to_string(view.size.height) + " x " +
                        std::to_string(view.size.width));
  }
  if (!(view.hfov > 0.0 && view.hfov < kPi)) {
    throw ArgumentError("hfov_deg: expected an angle between 0 and 180 degrees, got " +
                        std::to_string(degrees(view.hfov)));
  }
  if (!(std::abs(view.pitch) <= kPi / 2 + 1e-9)) {
    throw ArgumentError("pitch_deg: expected an angle from -90 to 90 degrees, got " +
                        std::to_string(degrees(view.pitch)));
  }
}

}  // namespace wiw::panorama
