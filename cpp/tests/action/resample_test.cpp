// SPDX-License-Identifier: Apache-2.0
#include "wiw/action/resample.hpp"

#include <doctest/doctest.h>

#include "wiw/core/error.hpp"

using namespace wiw;
using namespace wiw::action;

TEST_CASE("longer: linear, both ends kept") {
  const std::vector<PlanarPose> poses = {{0, 0, 0}, {1, 2, 1}};
  const auto longer = resample(poses, 5);
  REQUIRE(longer.size() == 5);
  for (int i = 0; i < 5; ++i) {
    CHECK(longer[static_cast<std::size_t>(i)].y == doctest::Approx(0.5 * i));
    CHECK(longer[static_cast<std::size_t>(i)].azimuth == doctest::Approx(0.25 * i));
  }
}

TEST_CASE("an azimuth that wraps turns the short way") {
  const auto longer = resample(std::vector<PlanarPose>{{0, 0, 3.0}, {0, 0, -3.0}}, 3);
  CHECK(longer[1].azimuth == doctest::Approx(kPi));
}

TEST_CASE("from a start the new poses are evenly spaced and end at the last") {
  const auto longer = resample(std::vector<PlanarPose>{{1, 0, 0}, {2, 0, 0}}, 8, PlanarPose{});
  for (std::size_t i = 0; i < 8; ++i) CHECK(longer[i].x == doctest::Approx(0.25 * static_cast<double>(i + 1)));
}

TEST_CASE("shorter: given poses only, ends kept") {
  std::vector<PlanarPose> poses;
  for (int i = 0; i < 10; ++i) poses.push_back({static_cast<double>(i), 0, 0});
  const auto shorter = resample(poses, 4);
  CHECK(shorter[0].x == 0);
  CHECK(shorter[1].x == 3);
  CHECK(shorter[2].x == 6);
  CHECK(shorter[3].x == 9);
  CHECK(resample(poses, 5, PlanarPose{-1, 0, 0})[0].x == 1);
  CHECK(resample(poses, 1)[0].x == 9);
}

TEST_CASE("rotations go along the great arc, the gripper in a step") {
  const std::vector<GripperPose> poses = {{{0, 0, 0}, {0, 0, 0}, 1}, {{0, 0, 1}, {1, 1, 1}, 0}};
  const auto longer = resample(poses, 5);
  const auto whole = to_quaternion(poses[0].rpy).angularDistance(to_quaternion(poses[1].rpy));
  for (std::size_t i = 0; i + 1 < 5; ++i) {
    CHECK(to_quaternion(longer[i].rpy).angularDistance(to_quaternion(longer[i + 1].rpy)) == doctest::Approx(whole / 4));
    CHECK(longer[i].gripper == 1);
  }
  CHECK(longer[4].gripper == 0);
  CHECK(longer[4].rpy == poses[1].rpy);
  CHECK(resample(poses, 5, {}, GripperRule::kNearest)[2].gripper == 0);
}

TEST_CASE("nothing to resample is refused") {
  CHECK_THROWS_AS(resample(std::vector<PlanarPose>{}, 3), ArgumentError);
  CHECK_THROWS_AS(resample(std::vector<PlanarPose>{{}}, 0), ArgumentError);
}
