// SPDX-License-Identifier: Apache-2.0
#include "wiw/action/trajectory.hpp"

#include <doctest/doctest.h>

#include "wiw/core/error.hpp"

using namespace wiw;
using namespace wiw::action;
using enum Action;

TEST_CASE("a left turn then a step moves forward and to the left") {
  const auto path = to_trajectory(ActionSequence{kTurnLeft, kForward, kStop, kNull}, {});
  REQUIRE(path.size() == 4);
  CHECK(path[0].x == 0);
  CHECK(path[0].azimuth == doctest::Approx(radians(22.5)));
  CHECK(path[1].x == doctest::Approx(0.2 * std::cos(radians(22.5))));
  CHECK(path[1].y == doctest::Approx(0.2 * std::sin(radians(22.5))));
  CHECK(path[3].x == path[1].x);
}

TEST_CASE("sixteen turns are exactly one circle and the azimuth keeps counting") {
  const auto path = to_trajectory(ActionSequence(16, kTurnRight), {});
  CHECK(path.back().azimuth == -2 * kPi);
}

TEST_CASE("a viewpoint is the trajectory in the camera convention") {
  const Pose camera = to_viewpoint({.x = 1, .y = 2, .azimuth = kPi / 2});
  CHECK(camera.translation().isApprox(Eigen::Vector3d(-2, 0, -1)));
  CHECK((camera.linear() * Eigen::Vector3d(0, 0, -1)).isApprox(Eigen::Vector3d(-1, 0, 0), 1e-12));
}

TEST_CASE("a pose seen from itself is the origin, and composition with viewpoints agrees") {
  const PlanarPose a{1, -0.5, 0.7};
  const PlanarPose b{-0.3, 0.4, 2.1};
  const PlanarPose same = relative_to(a, a);
  CHECK(same.x == 0);
  CHECK(same.azimuth == 0);
  CHECK(to_viewpoint(relative_to(a, b)).isApprox(to_viewpoint(a).inverse() * to_viewpoint(b), 1e-12));
}

TEST_CASE("steps that make no sense are refused") {
  CHECK_THROWS_AS(to_trajectory(ActionSequence{kForward}, {.forward_m = 0}), ArgumentError);
  CHECK_THROWS_AS(to_trajectory(ActionSequence{kForward}, {.turn_rad = -1}), ArgumentError);
  CHECK_THROWS_AS(to_action(5), ArgumentError);
  CHECK_THROWS_AS(to_action(std::string("left")), ArgumentError);
  CHECK(ActionSpace{}.turns_per_circle() == 16);
  CHECK(ActionSpace{.turn_rad = 0.3}.turns_per_circle() == 0);
  CHECK(ActionSpace{.turn_rad = radians(1e-3)}.turns_per_circle() == 360'000);
  CHECK(ActionSpace{.turn_rad = radians(1e-9)}.turns_per_circle() == 0);
}
