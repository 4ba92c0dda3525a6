// SPDX-License-Identifier: Apache-2.0
#include "wiw/panorama/projection.hpp"

#include <doctest/doctest.h>

#include "wiw/core/error.hpp"

using namespace wiw;
using namespace wiw::panorama;

TEST_CASE("the centre looks along -Z, columns grow to the right, rows grow downwards") {
  const Size size{180, 360};
  CHECK(pixel_direction(179.5, 89.5, size).isApprox(Eigen::Vector3d(0, 0, -1), 1e-12));
  CHECK(pixel_direction(179.5 + 90, 89.5, size).isApprox(Eigen::Vector3d(1, 0, 0), 1e-12));
  CHECK(pixel_direction(179.5 - 90, 89.5, size).isApprox(Eigen::Vector3d(-1, 0, 0), 1e-12));
  CHECK(pixel_direction(10, -0.5, size).isApprox(Eigen::Vector3d(0, 1, 0), 1e-12));
}

TEST_CASE("pixel and direction are inverse to each other, also at an aspect ratio other than 2:1") {
  for (const Size size : {Size{576, 1024}, Size{8, 64}, Size{5, 4}}) {
    for (double x = -0.5; x < size.width - 0.5; x += size.width / 37.0) {
      for (double y = -0.4; y < size.height - 0.5; y += size.height / 23.0) {
        const Eigen::Vector2d back = direction_pixel(3.0 * pixel_direction(x, y, size), size);
        // The leftmost edge is also the rightmost.
        CHECK(std::abs(std::remainder(back.x() - x, size.width)) < 1e-9);
        CHECK(back.y() == doctest::Approx(y).epsilon(1e-9));
      }
    }
  }
}

TEST_CASE("the field of view ends at pixel edges or at pixel centres") {
  PerspectiveView view{{10, 20}, radians(90), 0.0, FovConvention::kPixelEdges};
  CHECK(view_ray(19, 0, view).x() == doctest::Approx(0.95));
  CHECK(view_ray(19, 0, view).y() == doctest::Approx(0.45));
  view.convention = FovConvention::kPixelCenters;
  CHECK(view_ray(19, 0, view).x() == doctest::Approx(1.0));
  CHECK(view_ray(19, 0, view).y() == doctest::Approx(1.0));
}

TEST_CASE("impossible sizes and angles are refused") {
  CHECK_THROWS_AS(check_panorama_size({10, 11}), ArgumentError);
  CHECK_THROWS_AS(check_panorama_size({0, 12}), ArgumentError);
  CHECK_THROWS_AS(check_panorama_size({32767, 32766}), ArgumentError);
  CHECK_THROWS_AS(check_view({{4, 4}, kPi, 0.0}), ArgumentError);
  CHECK_THROWS_AS(check_view({{4, 4}, 0.0, 0.0}), ArgumentError);
  CHECK_THROWS_AS(check_view({{4, 4}, std::nan(""), 0.0}), ArgumentError);
  CHECK_THROWS_AS(check_view({{4, 4}, 1.0, 2.0}), ArgumentError);
  CHECK_THROWS_AS(check_view({{0, 4}, 1.0, 0.0}), ArgumentError);
}
