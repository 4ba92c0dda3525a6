// SPDX-License-Identifier: Apache-2.0
#include "wiw/action/vocabulary.hpp"

#include <doctest/doctest.h>

#include "wiw/action/gripper_pose.hpp"
#include "wiw/core/error.hpp"
#include "wiw/core/intrinsics.hpp"

using namespace wiw;
using namespace wiw::action;
using enum Action;

TEST_CASE("ids and vectors of a model") {
  const Vocabulary words({{kForward, {0, 1}}, {kTurnLeft, {2, 3}}});
  CHECK(words.encode(ActionSequence{kTurnLeft, kForward}) == std::vector<double>{2, 3, 0, 1});
  CHECK_THROWS_WITH_AS(
      words.encode(ActionSequence{kStop}),
      "the model's vocabulary has no entry for 'stop' (it knows forward, turn_left): add one, or leave "
      "the action out of the plan",
      ArgumentError);
  CHECK_THROWS_AS(Vocabulary({{kForward, {1}}, {kStop, {1, 2}}}), ArgumentError);
  CHECK_THROWS_AS(Vocabulary({}), ArgumentError);
}

TEST_CASE("angles survive the way through a quaternion, also at the poles") {
  for (const double roll : {-2.0, 0.3, 3.0}) {
    for (const double pitch : {-kPi / 2, -1.0, 0.0, 1.2, kPi / 2}) {
      for (const double yaw : {-3.0, 0.0, 0.7}) {
        const auto rotation = to_quaternion({roll, pitch, yaw});
        CHECK(rotation.angularDistance(to_quaternion(to_rpy(rotation))) < 1e-6);
      }
    }
  }
}

TEST_CASE("gripper poses as numbers") {
  GripperVocabulary words{.rotation = RotationCode::kMatrix6d,
                          .bounds = Eigen::AlignedBox3d(Eigen::Vector3d(0, 0, 0), Eigen::Vector3d(1, 2, 4))};
  std::vector<double> values;
  words.encode({{0.5, 2, 0}, {0, 0, kPi / 2}, 1}, values);
  const std::vector<double> expected = {0, 1, -1, 0, 1, 0, -1, 0, 0, 1};
  REQUIRE(values.size() == static_cast<std::size_t>(words.width()));
  for (std::size_t i = 0; i < values.size(); ++i) CHECK(values[i] == doctest::Approx(expected[i]));
  words.bounds = Eigen::AlignedBox3d(Eigen::Vector3d(0, 0, 0), Eigen::Vector3d(1, 0, 4));
  CHECK_THROWS_AS(words.check(), ArgumentError);
}
