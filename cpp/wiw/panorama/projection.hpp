// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <Eigen/Core>
#include <vector>

#include "wiw/core/intrinsics.hpp"

namespace wiw::panorama {

/// How bilinear or nearest texels are picked between pixel centres.
enum class Interpolation { kBilinear, kNearest };

/// Where a field of view of a perspective image ends.
enum class FovConvention {
  kPixelEdges,    // outer edges of the outer pixels, square pixels: this project's convention
  kPixelCenters,  // centres of the outer pixels, the same angle in both axes: py360convert.e2p
};

/// A perspective view to be cut out of a panorama; angles in radians, pitch positive up.
struct PerspectiveView {
  Size size;
  double hfov = kPi / 2;
  double pitch = 0.0;
  FovConvention convention = FovConvention::kPixelEdges;
};

/// Continuous pixel coordinates in a panorama, one per output pixel: column x and row y, 0 at the first pixel's
/// centre. x lies in [-0.5, W - 0.5), y in [-0.5, H - 0.5].
struct Coordinates {
  std::vector<double> x;
  std::vector<double> y;
};

/// Unit vector through pixel (x, y): columns cover 360 degrees with -Z in the middle and +X to the right, rows cover
/// 180 degrees from +Y down, whatever the aspect ratio.
Eigen::Vector3d pixel_direction(double x, double y, const Size& panorama);

/// Inverse of pixel_direction for a vector of any length; the columns wrap at the back (+Z).
Eigen::Vector2d direction_pixel(const Eigen::Vector3d& direction, const Size& panorama);

/// Vector [x, y, -1] through pixel (u, v) of a perspective view before pitch is applied.
Eigen::Vector3d view_ray(int u, int v, const PerspectiveView& view);

/// Where each pixel of `view` (heading: the panorama's centre) looks up `panorama`.
Coordinates perspective_coordinates(const Size& panorama, const PerspectiveView& view);

/// float [H, W, 3]: the unit vector through each pixel's centre.
void directions(const Size& panorama, float* out);

/// Throws ArgumentError unless both sides are positive, below 32768, the width is even (across a pole the neighbour
/// of a texel is the one half a turn away, which an odd width does not have) and byte offsets fit 31 bits.
void check_panorama_size(const Size& panorama);

/// Throws ArgumentError for an empty view, a field of view outside (0, 180) degrees or a pitch beyond 90 degrees.
void check_view(const PerspectiveView& view);

}  // namespace wiw::panorama
