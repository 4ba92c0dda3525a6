// SPDX-License-Identifier: Apache-2.0
#include <doctest/doctest.h>

#include <algorithm>
#include <array>

#include "env/rooms.hpp"
#include "wiw/core/error.hpp"
#include "wiw/env/vector_env.hpp"

using namespace wiw;
using namespace wiw::env;
using namespace wiw::testing;

namespace {

/// Two neighbours in one world, one in another, and one in the first again.
std::vector<NavigationEnv> four() {
  static const std::array worlds{make_world(0.3f), make_world(0.8f)};
  std::vector<NavigationEnv> envs;
  for (std::size_t i = 0; i < 4; ++i) {
    envs.emplace_back(worlds[i == 2 ? 1 : 0], small_pictures(i == 1 ? Motion::kSlide : Motion::kRefuse));
    envs.back().reset({1.0 + 0.3 * static_cast<double>(i), 0, 1.5}, 0.7 * static_cast<double>(i));
  }
  return envs;
}

}  // namespace

TEST_CASE("a vector of environments moves and sees as its members do one by one") {
  std::vector<NavigationEnv> singles = four();
  VectorEnv vector(singles);
  REQUIRE(vector.size() == 4);
  const NavigationConfig& config = singles[0].config();
  for (int step = 0; step < 25; ++step) {
    std::array<action::Action, 4> actions{};
    std::array<bool, 4> moved{}, expected{};
    Pictures together(config, 4);
    for (std::size_t i = 0; i < 4; ++i) {
      actions[i] = action::to_action((step * 7 + static_cast<int>(i) * 3 + step / 5) % action::kActionCount);
      expected[i] = singles[i].step(actions[i]);
    }
    vector.step(actions, moved);
    vector.observe(together.targets());
    CHECK(moved == expected);
    for (std::size_t i = 0; i < 4; ++i) {
      Pictures alone(config);
      singles[i].observe(alone.targets());
      const auto same = [&](const auto& part, const auto& whole) {
        return std::equal(part.begin(), part.end(), whole.begin() + static_cast<std::ptrdiff_t>(i * part.size()));
      };
      CHECK(same(alone.panorama, together.panorama));
      CHECK(same(alone.front, together.front));
      CHECK(same(alone.depth, together.depth));
      CHECK(vector.env(i).T_world_camera().matrix() == singles[i].T_world_camera().matrix());
    }
  }
}

TEST_CASE("replacing one environment leaves the others alone") {
  std::vector<NavigationEnv> singles = four();
  VectorEnv vector(singles);
  NavigationEnv other = singles[2];
  other.reset({5, 0, 1}, 2);
  vector.replace(0, other);
  CHECK(vector.env(0).position() == other.position());
  CHECK(vector.env(0).world().renderer == singles[2].world().renderer);
  CHECK(vector.env(1).position() == singles[1].position());
  CHECK_THROWS_AS(vector.replace(4, other), std::out_of_range);
}

TEST_CASE("environments that see differently, or a wrong number of actions, are refused") {
  std::vector<NavigationEnv> envs = four();
  NavigationConfig wide = small_pictures(), large = small_pictures();
  wide.front_hfov = radians(120);
  large.panorama = {64, 128};
  for (const NavigationConfig& config : {wide, large}) {
    const NavigationEnv other(envs[0].world(), config);
    CHECK_THROWS_AS(VectorEnv({envs[0], other}), ArgumentError);
    CHECK_THROWS_AS(VectorEnv(envs).replace(1, other), ArgumentError);
  }
  CHECK_THROWS_AS(VectorEnv({}), ArgumentError);
  std::array<bool, 4> moved{};
  const std::array three{action::Action::kStop, action::Action::kStop, action::Action::kStop};
  CHECK_THROWS_AS(VectorEnv(envs).step(three, moved), ArgumentError);
}
