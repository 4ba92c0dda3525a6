// SPDX-License-Identifier: Apache-2.0
#include "wiw/metrics/scores.hpp"

#include <doctest/doctest.h>

#include <limits>

#include "wiw/core/error.hpp"
#include "wiw/metrics/pose_error.hpp"

using namespace wiw;
using namespace wiw::metrics;
using List = std::vector<double>;

TEST_CASE("detours cost, shortcuts do not pay") {
  CHECK(path_efficiency(List{1, 1, 0, 0.5}, List{2, 2, 2, 2}, List{4, 1, 2, 4}) == List{0.5, 1, 0, 0.25});
}

TEST_CASE("starting at the goal") {
  CHECK(path_efficiency(List{1, 1, 0}, List{0, 0, 0}, List{0, 1, 0}) == List{1, 0, 0});
}

TEST_CASE("what cannot be is refused") {
  const double inf = std::numeric_limits<double>::infinity();
  const double nan = std::numeric_limits<double>::quiet_NaN();
  CHECK(path_efficiency(List{0}, List{inf}, List{3}) == List{0});
  CHECK_THROWS_AS(path_efficiency(List{1}, List{inf}, List{3}), ArgumentError);
  CHECK_THROWS_AS(path_efficiency(List{2}, List{1}, List{3}), ArgumentError);
  CHECK_THROWS_AS(path_efficiency(List{1}, List{nan}, List{3}), ArgumentError);
  CHECK_THROWS_AS(path_efficiency(List{0}, List{1}, List{-1}), ArgumentError);
  CHECK_THROWS_AS(path_efficiency(List{1}, List{1}, List{1, 2}), ArgumentError);
  CHECK_THROWS_AS(answer_credit(List{nan}), ArgumentError);
  CHECK_THROWS_AS(mean(List{}), ArgumentError);
}

TEST_CASE("answers from 1 to 5 become 0 to 1") { CHECK(answer_credit(List{1, 3, 5, 0, 7}) == List{0, 0.5, 1, 0, 1}); }

TEST_CASE("pose errors") {
  const PoseError error = pose_error(pose_from_yaw({0, 0, 0}, 3.0), pose_from_yaw({3, 0, 4}, -3.0));
  CHECK(error.translation_m == doctest::Approx(5));
  CHECK(error.rotation_rad == doctest::Approx(2 * (3.14159265358979 - 3)));
}
