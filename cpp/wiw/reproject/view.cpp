// SPDX-License-Identifier: Apache-2.0
#include "wiw/reproject/view.hpp"

#include <cmath>
#include <string>

#include "wiw/core/error.hpp"

namespace wiw::reproject {

RayTable make_rays(const View& view, const std::vector<double>& columns, const std::vector<double>& rows) {
  RayTable rays;
  const double focal = view.panoramic ? 1.0 : Intrinsics{view.size, view.hfov}.focal();
  for (const double column : columns) {
    const double offset = column + 0.5 - view.size.width / 2.0;
    const double longitude = offset / view.size.width * 2.0 * kPi;
    rays.x.push_back(static_cast<float>(view.panoramic ? std::sin(longitude) : offset / focal));
    rays.z.push_back(static_cast<float>(view.panoramic ? -std::cos(longitude) : -1.0));
  }
  for (const double row : rows) {
    const double offset = view.size.height / 2.0 - row - 0.5;
    const double latitude = offset / view.size.height * kPi;
    rays.m.push_back(static_cast<float>(view.panoramic ? std::cos(latitude) : 1.0));
    rays.y.push_back(static_cast<float>(view.panoramic ? std::sin(latitude) : offset / focal));
  }
  return rays;
}

void check_view(const View& view, const char* name) {
  const auto fits = [](int side) { return side >= 2 && side <= 32766; };
  if (!fits(view.size.height) || !fits(view.size.width) || view.size.pixels() > (std::size_t{1} << 29)) {
    throw ArgumentError(std::string(name) + ": expected (H, W) from 2 to 32766 each and at most 2^29 pixels, got " +
                        std::to_string(view.size.height) + " x " + std::to_string(view.size.width));
  }
  if (!view.panoramic && !(view.hfov > 0.0 && view.hfov < kPi)) {
    throw ArgumentError(std::string(name) + ": expected a field of view between 0 and 180 degrees, got " +
                        std::to_string(degrees(view.hfov)));
  }
}

}  // namespace wiw::reproject
