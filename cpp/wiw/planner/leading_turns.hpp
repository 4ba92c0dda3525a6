// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <span>
#include <vector>

#include "wiw/planner/model_spec.hpp"

namespace wiw::planner {

/// A plan cut where its leading turns end. The outcome of each step before the cut is the real panorama, rolled.
struct SplitPlan {
  std::vector<int> rolled;      // net left turns after each leading step
  action::ActionSequence rest;  // what the model is asked
  int turns = 0;                // net left turns before `rest`
};

/// Stop and null move nothing, so in front they stay with the leading part. Turn counts are brought to
/// (-half a circle, half a circle] where a circle is a whole number of turns.
SplitPlan split_leading_turns(std::span<const action::Action> plan, Leading leading, const action::ActionSpace& space);

}  // namespace wiw::planner
