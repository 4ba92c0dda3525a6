// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <vector>

#include "wiw/core/intrinsics.hpp"

namespace wiw::reproject {

/// What an image sees: the whole sphere, or a pinhole view. Depth is the distance along the ray for a panorama and
/// planar z for a pinhole view; 0 where nothing is hit.
struct View {
  bool panoramic = true;
  Size size;
  double hfov = kPi / 2;  // radians, pinhole only
  bool operator==(const View&) const = default;
};

/// Rays as products of a column's and a row's part: ray(row, column) = (x[column] m[row], y[row], z[column] m[row]).
/// Times depth it is the point seen.
struct RayTable {
  std::vector<float> x, z;  // per column
  std::vector<float> m, y;  // per row
};

/// Rays through the given pixel coordinates (0 at the centre of the first pixel), one list per axis.
RayTable make_rays(const View& view, const std::vector<double>& columns, const std::vector<double>& rows);

/// Throws ArgumentError unless the size is from 2 x 2 to 32766 x 32766 and a pinhole's angle between 0 and 180 degrees.
void check_view(const View& view, const char* name);

}  // namespace wiw::reproject
