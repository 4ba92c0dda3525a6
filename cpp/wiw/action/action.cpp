// SPDX-License-Identifier: Apache-2.0
#include "wiw/action/action.hpp"

#include <array>
#include <cmath>

#include "wiw/core/error.hpp"

namespace wiw::action {

namespace {
constexpr std::array<const char*, kActionCount> kNames = {"null", "forward", "turn_left", "turn_right", "stop"};
constexpr const char* kExpected = "expected null (0), forward (1), turn_left (2), turn_right (3) or stop (4)";
}  // namespace

const char* action_name(Action action) { return kNames.at(static_cast<std::size_t>(action)); }

Action to_action(long long id) {
  if (id < 0 || id >= kActionCount) throw ArgumentError("unknown action " + std::to_string(id) + ": " + kExpected);
  return static_cast<Action>(id);
}

Action to_action(const std::string& name) {
  for (int id = 0; id < kActionCount; ++id) {
    if (name == kNames[static_cast<std::size_t>(id)]) return static_cast<Action>(id);
  }
  throw ArgumentError("unknown action '" + name + "': " + kExpected);
}

void ActionSpace::check() const {
  if (!std::isfinite(forward_m) || forward_m <= 0) {
    throw ArgumentError("ActionSpace: expected a positive forward step in metres, got " + std::to_string(forward_m));
  }
  if (!std::isfinite(turn_rad) || turn_rad <= 0 || turn_rad > kPi) {
    throw ArgumentError("ActionSpace: expected a turn above 0 and up to 180 degrees, got " +
                        std::to_string(degrees(turn_rad)));
  }
}

int ActionSpace::turns_per_circle() const {
  constexpr double kMost = 1e6;  // finer turns: rounding alone would make every number a whole one
  const double turns = 2 * kPi / turn_rad;
  if (turns > kMost) return 0;
  return std::abs(turns - std::round(turns)) < 1e-9 * turns ? static_cast<int>(std::lround(turns)) : 0;
}

}  // namespace wiw::action
