// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstdint>
#include <span>
#include <string>
#include <vector>

#include "wiw/core/intrinsics.hpp"

namespace wiw::action {

/// Navigation primitives, in the numbering of action-conditioned world models. `kNull` is no action: it stands in front
/// of the first frame, which no action precedes, where a model wants one token a frame.
enum class Action : std::int8_t { kNull = 0, kForward = 1, kTurnLeft = 2, kTurnRight = 3, kStop = 4 };
constexpr int kActionCount = 5;

/// A plan: action k leads from observation k to observation k + 1.
using ActionSequence = std::vector<Action>;

/// Lower-case name: "null", "forward", "turn_left", "turn_right", "stop".
const char* action_name(Action action);

/// Throws ArgumentError if no primitive has this number or name.
Action to_action(long long id);
Action to_action(const std::string& name);

/// +1 for a left turn, -1 for a right turn, 0 otherwise.
constexpr int turn_sign(Action action) {
  return action == Action::kTurnLeft ? 1 : (action == Action::kTurnRight ? -1 : 0);
}

/// How far one primitive moves the agent (the paper: 0.2 m and 22.5 degrees).
struct ActionSpace {
  double forward_m = 0.2;
  double turn_rad = radians(22.5);
  bool operator==(const ActionSpace&) const = default;

  /// Throws ArgumentError unless both steps are finite and positive and a turn is at most half a circle.
  void check() const;
  /// Number of turns in a full circle if it is whole (16 for 22.5 degrees) and at most a million, else 0.
  [[nodiscard]] int turns_per_circle() const;
};

}  // namespace wiw::action
