// SPDX-License-Identifier: Apache-2.0
#include "wiw/planner/leading_turns.hpp"

namespace wiw::planner {

namespace {

int within_circle(int turns, int circle) {
  if (circle == 0) return turns;
  const int wrapped = ((turns % circle) + circle) % circle;
  return 2 * wrapped > circle ? wrapped - circle : wrapped;
}

}  // namespace

SplitPlan split_leading_turns(std::span<const action::Action> plan, Leading leading, const action::ActionSpace& space) {
  SplitPlan split;
  const int circle = space.turns_per_circle();
  std::size_t step = 0;
  int net = 0;
  for (; leading != Leading::kNone && step < plan.size() && plan[step] != action::Action::kForward; ++step) {
    const int sign = action::turn_sign(plan[step]);
    if (leading == Leading::kSameDirection && sign * net < 0) break;
    net += sign;
    split.rolled.push_back(within_circle(net, circle));
  }
  split.turns = within_circle(net, circle);
  split.rest.assign(plan.begin() + static_cast<std::ptrdiff_t>(step), plan.end());
  return split;
}

}  // namespace wiw::planner
