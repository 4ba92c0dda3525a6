// SPDX-License-Identifier: Apache-2.0
#include "wiw/action/text.hpp"

#include <doctest/doctest.h>

#include "wiw/core/error.hpp"

using namespace wiw;
using namespace wiw::action;
using enum Action;

TEST_CASE("every action becomes a phrase, runs merge when asked") {
  TextTemplate words{.prompt = "Go: {actions}.", .separator = "; "};
  const ActionSequence plan = {kForward, kForward, kTurnLeft, kForward};
  CHECK(to_text(plan, words, {}) ==
        "Go: move forward 0.2 m; move forward 0.2 m; turn left 22.5 degrees; move forward 0.2 m.");
  words.merge_runs = true;
  CHECK(to_text(plan, words, {}) == "Go: move forward 0.4 m; turn left 22.5 degrees; move forward 0.2 m.");
}

TEST_CASE("text put in for a placeholder is not filled again") {
  TextTemplate words{.prompt = "{actions}|{actions}"};
  words.phrases[1] = "{actions} {metres}{count}{other}";
  CHECK(to_text(ActionSequence{kForward}, words, {}) == "{actions} 0.21{other}|{actions} 0.21{other}");
}

TEST_CASE("a prompt without a place for the actions is refused") {
  CHECK_THROWS_AS(to_text(ActionSequence{kForward}, {.prompt = "walk"}, {}), ArgumentError);
}

TEST_CASE("gripper poses in words") {
  const GripperTextTemplate words{.prompt = "{actions}", .phrase = "{x} {y} {z} {roll} {pitch} {yaw} {gripper}"};
  const std::vector<GripperPose> plan = {{{0.1, -0.25, 1}, {kPi / 2, 0, -kPi}, 0}};
  CHECK(to_text(plan, words) == "0.10 -0.25 1.00 90 0 -180 closed");
}
