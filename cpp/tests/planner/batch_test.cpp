// SPDX-License-Identifier: Apache-2.0
#include "wiw/planner/batch.hpp"

#include <doctest/doctest.h>

#include "wiw/core/error.hpp"

using namespace wiw;
using namespace wiw::planner;
using enum action::Action;

namespace {
constexpr auto F = kForward;
constexpr auto L = kTurnLeft;
constexpr auto R = kTurnRight;
}  // namespace

TEST_CASE("equal plans are one row, pure turns are none") {
  const Batch batch({{{L, F, F}, {L, F, F}, {L, L}, {}}}, {});
  REQUIRE(batch.rows().size() == 1);
  CHECK(batch.rows()[0].turns == 1);
  CHECK(batch.sources(0) == batch.sources(1));
  CHECK(batch.sources(0) == std::vector<Source>{{-1, 1}, {0, 1}, {0, 2}});
  CHECK(batch.sources(2) == std::vector<Source>{{-1, 1}, {-1, 2}});
  CHECK(batch.sources(3).empty());
}

TEST_CASE("episodes do not mix") {
  const Batch batch({{{F}}, {}, {{F}}}, {.causal = true});
  REQUIRE(batch.rows().size() == 2);
  CHECK(batch.rows()[1].episode == 2);
  CHECK(batch.rows()[1].shared == 0);
  CHECK(batch.episodes() == std::vector<int>{0, 2});
}

TEST_CASE("a causal model answers a plan that another begins with, and marks common beginnings") {
  const Batch batch({{{F, F}, {F, F, L, F}, {F, F, R}, {F, L}}}, {.causal = true});
  REQUIRE(batch.rows().size() == 3);
  CHECK(batch.sources(0) == std::vector<Source>{{0, 1}, {0, 2}});
  CHECK(batch.sources(2) == std::vector<Source>{{0, 1}, {0, 2}, {1, 3}});
  CHECK(batch.rows()[1].shared == 2);
  CHECK(batch.rows()[2].shared == 1);
  REQUIRE(batch.calls().size() == 1);
  CHECK(batch.calls()[0].steps == 4);
  CHECK(batch.calls()[0].shared == std::vector<int>{0, 2, 1});
  CHECK(batch.calls()[0].length == std::vector<int>{4, 3, 2});
}

TEST_CASE("a model that looks ahead is asked for each length, unless padding makes plans equal") {
  const Plans plans = {{{F}, {F, F}, {F, L}}};
  const Batch any(plans, {});
  CHECK(any.rows().size() == 3);
  REQUIRE(any.calls().size() == 2);
  CHECK(any.calls()[0].steps == 2);
  CHECK(any.calls()[1].rows == std::vector<int>{0});
  const Batch padded(plans, {.frames = 5});
  REQUIRE(padded.rows().size() == 2);
  CHECK(padded.rows()[0].actions == action::ActionSequence{F, F});
  CHECK(padded.calls()[0].actions[1] == action::ActionSequence{F, L, F, F});
}

TEST_CASE("long plans are rolled out in calls, and a first call that is the same is made once") {
  const Batch batch({{{F, F, F, L, L}, {F, F, F, R}}}, {.frames = 4, .padding = action::Padding::kNull});
  REQUIRE(batch.calls().size() == 2);
  CHECK(batch.calls()[0].rows == std::vector<int>{0});
  const ModelCall& second = batch.calls()[1];
  CHECK(second.rows == std::vector<int>{0, 1});
  CHECK(second.first == 3);
  CHECK(second.start == std::vector<Source>{{0, 3}, {0, 3}});
  CHECK(second.actions[1] == action::ActionSequence{R, kNull, kNull});
  CHECK(batch.sources(1) == std::vector<Source>{{0, 1}, {0, 2}, {0, 3}, {1, 4}});
  const Batch::FrameAddress place = batch.place({1, 4});
  CHECK(place.call == 1);
  CHECK(place.index == 1);
  CHECK(place.frame == 1);
}

TEST_CASE("calls are no larger than asked") {
  const Batch batch({{{F, L}, {F, R}, {F, F}}, {{F}}}, {.causal = true, .max_rows = 2});
  REQUIRE(batch.calls().size() == 2);
  CHECK(batch.calls()[0].rows == std::vector<int>{0, 1});
  CHECK(batch.calls()[1].rows == std::vector<int>{2, 3});
  CHECK(batch.calls()[1].shared == std::vector<int>{0, 0});  // the row it shares with is in another call
}

TEST_CASE("where only ends are read, frames before them are marked") {
  const Plans plans = {{{F, F}, {F, F, L, F}, {F, F, R}, {L, L}, {}}};
  const Batch batch(plans, {.causal = true, .ends = true});
  REQUIRE(batch.rows().size() == 2);
  CHECK(batch.sources(0) == std::vector<Source>{{0, 2}});
  CHECK(batch.sources(1) == std::vector<Source>{{0, 4}});
  CHECK(batch.sources(2) == std::vector<Source>{{1, 3}});
  CHECK(batch.sources(3) == std::vector<Source>{{-1, 2}});
  CHECK(batch.sources(4).empty());
  CHECK(batch.longest() == 1);
  REQUIRE(batch.calls().size() == 1);
  CHECK(batch.calls()[0].length == std::vector<int>{4, 3});
  CHECK(batch.calls()[0].shared == std::vector<int>{1, 2});  // frame 2 of the first row is where the first plan ends
}

TEST_CASE("a later call begins with a frame of the one before, so all of these are written") {
  const Batch batch({{{F, F, F, L, L}}}, {.frames = 4, .ends = true});
  REQUIRE(batch.calls().size() == 2);
  CHECK(batch.calls()[0].shared == std::vector<int>{0});
  CHECK(batch.calls()[1].shared == std::vector<int>{0});
  CHECK(batch.sources(0) == std::vector<Source>{{0, 5}});
}

TEST_CASE("impossible models are refused") {
  CHECK_THROWS_AS(Batch({}, {.frames = 1}), ArgumentError);
  CHECK_THROWS_AS(Batch({}, {.max_rows = -1}), ArgumentError);
  CHECK(Batch({}, {}).calls().empty());
}
