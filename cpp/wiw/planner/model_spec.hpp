// SPDX-License-Identifier: Apache-2.0
#pragma once

#include "wiw/action/length.hpp"

namespace wiw::planner {

/// Which turns at the start of a plan are answered by rolling the real panorama instead of asking the model.
enum class Leading {
  kNone,
  kSameDirection,  // up to the first forward or reversing turn
  kAny,            // up to the first forward
};

/// Properties of a world model that the planner needs.
struct ModelSpec {
  bool causal = false;  // frame k depends on actions 1..k only
  int frames = 0;       // length of a rollout, the observation included; 0: any
  action::Padding padding = action::Padding::kForward;
  Leading leading = Leading::kSameDirection;
  int max_rows = 0;   // most rows in one call; 0: all at once
  bool ends = false;  // of each plan only the last observation is read
  action::ActionSpace space;

  /// Actions one call answers; 0: any number.
  [[nodiscard]] int steps() const { return frames == 0 ? 0 : frames - 1; }
  /// Throws ArgumentError for impossible numbers.
  void check() const;
};

}  // namespace wiw::planner
