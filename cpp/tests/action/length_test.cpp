// SPDX-License-Identifier: Apache-2.0
#include "wiw/action/length.hpp"

#include <doctest/doctest.h>

#include "wiw/core/error.hpp"

using namespace wiw;
using namespace wiw::action;
using enum Action;

TEST_CASE("padding fills up, never cuts") {
  const ActionSequence plan = {kTurnLeft, kTurnRight};
  CHECK(pad(plan, 4, Padding::kForward) == ActionSequence{kTurnLeft, kTurnRight, kForward, kForward});
  CHECK(pad(plan, 3, Padding::kRepeat) == ActionSequence{kTurnLeft, kTurnRight, kTurnRight});
  CHECK(pad({}, 2, Padding::kNull) == ActionSequence{kNull, kNull});
  CHECK_THROWS_AS(pad(plan, 1, Padding::kForward), ArgumentError);
  CHECK_THROWS_AS(pad({}, 1, Padding::kRepeat), ArgumentError);
}

TEST_CASE("chunks cover the plan in order") {
  const auto chunks = chunk(ActionSequence{kForward, kTurnLeft, kStop}, 2, Padding::kNull);
  REQUIRE(chunks.size() == 2);
  CHECK(chunks[0] == ActionSequence{kForward, kTurnLeft});
  CHECK(chunks[1] == ActionSequence{kStop, kNull});
  CHECK(chunk({}, 2, Padding::kNull).empty());
}

TEST_CASE("frame 0 is the observation") {
  CHECK(frames_of_actions(3, 14, Fit::kPad)[2].frame == 3);
  const auto chunked = frames_of_actions(5, 3, Fit::kChunk);
  CHECK(chunked[2].chunk == 1);
  CHECK(chunked[2].frame == 1);
  CHECK(chunked[4].chunk == 2);
  const auto spread = frames_of_actions(5, 26, Fit::kResample);
  for (std::size_t k = 0; k < 5; ++k) CHECK(spread[k].frame == static_cast<int>(5 * (k + 1)));
  CHECK(frames_of_actions(50, 14, Fit::kResample).back().frame == 13);
  CHECK_THROWS_AS(frames_of_actions(14, 14, Fit::kPad), ArgumentError);
  CHECK_THROWS_AS(frames_of_actions(1, 1, Fit::kChunk), ArgumentError);
  CHECK_THROWS_AS(frames_of_actions(3, std::size_t{1} << 40, Fit::kResample), ArgumentError);
}
