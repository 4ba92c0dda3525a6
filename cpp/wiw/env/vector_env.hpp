// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <span>
#include <vector>

#include "wiw/env/navigation_env.hpp"

namespace wiw::env {

/// Several environments stepped and observed together. They may be in different scenes; those of one scene share its
/// renderer and navigation mesh.
class VectorEnv {
 public:
  /// All must have the same observation sizes and field of view. Throws ArgumentError otherwise.
  explicit VectorEnv(std::vector<NavigationEnv> envs);

  [[nodiscard]] std::size_t size() const { return envs_.size(); }
  NavigationEnv& env(std::size_t i) { return envs_.at(i); }

  /// Puts another environment in place i, such as one at the start of the next episode. Throws ArgumentError when it
  /// would observe in other sizes, std::out_of_range for a place that does not exist.
  void replace(std::size_t i, const NavigationEnv& env);

  /// One primitive each; moved[i] tells whether environment i changed its pose. kNull leaves an environment as it is.
  void step(std::span<const action::Action> actions, std::span<bool> moved);

  /// Writes batch-major observations: members of `targets` are [N, ...]. Neighbours in one scene are one batch for its
  /// renderer.
  void observe(const ObservationTargets& targets) const;

 private:
  std::vector<NavigationEnv> envs_;
};

}  // namespace wiw::env
