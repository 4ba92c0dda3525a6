// SPDX-License-Identifier: Apache-2.0
#include "wiw/planner/leading_turns.hpp"

#include <doctest/doctest.h>

using namespace wiw;
using namespace wiw::planner;
using enum action::Action;

TEST_CASE("turns up to the first forward are rolled") {
  const auto split = split_leading_turns(action::ActionSequence{kTurnLeft, kTurnLeft, kForward, kTurnLeft},
                                         Leading::kSameDirection, {});
  CHECK(split.rolled == std::vector<int>{1, 2});
  CHECK(split.turns == 2);
  CHECK(split.rest == action::ActionSequence{kForward, kTurnLeft});
}

TEST_CASE("a reversing turn ends the leading part, unless any turn may lead") {
  const action::ActionSequence plan = {kTurnRight, kTurnRight, kTurnLeft, kForward};
  const auto same = split_leading_turns(plan, Leading::kSameDirection, {});
  CHECK(same.turns == -2);
  CHECK(same.rest == action::ActionSequence{kTurnLeft, kForward});
  const auto any = split_leading_turns(plan, Leading::kAny, {});
  CHECK(any.rolled == std::vector<int>{-1, -2, -1});
  CHECK(any.rest == action::ActionSequence{kForward});
  const auto none = split_leading_turns(plan, Leading::kNone, {});
  CHECK(none.rolled.empty());
  CHECK(none.rest == plan);
}

TEST_CASE("standing still in front costs no imagination") {
  const auto split = split_leading_turns(action::ActionSequence{kStop, kTurnLeft, kNull, kForward, kStop},
                                         Leading::kSameDirection, {});
  CHECK(split.rolled == std::vector<int>{0, 1, 1});
  CHECK(split.rest == action::ActionSequence{kForward, kStop});
}

TEST_CASE("nine turns left are seven turns right") {
  CHECK(split_leading_turns(action::ActionSequence(9, kTurnLeft), Leading::kSameDirection, {}).turns == -7);
  CHECK(split_leading_turns(action::ActionSequence(8, kTurnRight), Leading::kSameDirection, {}).turns == 8);
  CHECK(split_leading_turns(action::ActionSequence(9, kTurnLeft), Leading::kSameDirection, {.turn_rad = 0.4}).turns ==
        9);
}
