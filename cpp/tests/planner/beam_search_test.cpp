// SPDX-License-Identifier: Apache-2.0
#include "wiw/planner/beam_search.hpp"

#include <doctest/doctest.h>

#include <limits>

#include "wiw/core/error.hpp"

using namespace wiw;
using namespace wiw::planner;
using enum action::Action;

TEST_CASE("the best are kept in order, ties go to the lower index") {
  BeamSearch search(2);
  search.ask(Plans{{{kForward}, {kTurnLeft}, {kTurnRight}}, {{kForward}}, {}});
  const auto kept = search.tell({{1, 3, 3}, {-std::numeric_limits<double>::infinity()}, {}});
  CHECK(kept == std::vector<std::vector<int>>{{1, 2}, {0}, {}});
  CHECK(search.done());
  CHECK(search.beams()[0][0].plan == action::ActionSequence{kTurnLeft});
  CHECK(search.beams()[2].empty());
}

TEST_CASE("the next level extends what was kept and remembers where it came from") {
  BeamSearch search(2, 2);
  search.ask(Plans{{{kForward}, {kTurnLeft}, {kTurnRight}}});
  search.tell({{0, 1, 2}});
  const Plans& plans = search.ask(std::vector<Plans>{{{{kForward}}, {{}, {kStop}}}});
  CHECK(plans == Plans{{{kTurnRight, kForward}, {kTurnLeft}, {kTurnLeft, kStop}}});
  CHECK(search.tell({{0, 5, 7}}) == std::vector<std::vector<int>>{{2, 1}});
  CHECK(search.beams()[0][0].origin == 1);
  CHECK(search.beams()[0][0].score == 7);
}

TEST_CASE("what does not fit is refused and can be told again") {
  BeamSearch search(1, 2);
  CHECK_THROWS_AS(search.tell({{1}}), ArgumentError);
  search.ask(Plans{{{kForward}}});
  CHECK_THROWS_AS(search.ask(Plans{{{kForward}}}), ArgumentError);
  CHECK_THROWS_AS(search.tell({{std::numeric_limits<double>::quiet_NaN()}}), ArgumentError);
  CHECK_THROWS_AS(search.tell({{1, 2}}), ArgumentError);
  CHECK_THROWS_AS(search.tell({}), ArgumentError);
  search.tell({{1}});
  CHECK_THROWS_AS(search.ask(Plans{{{kForward}}}), ArgumentError);
  CHECK_THROWS_AS(search.ask(std::vector<Plans>{{}}), ArgumentError);
  CHECK_THROWS_AS(BeamSearch(0), ArgumentError);
}
