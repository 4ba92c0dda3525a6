// SPDX-License-Identifier: Apache-2.0
#include "wiw/env/vector_env.hpp"

#include "wiw/core/error.hpp"
#include "wiw/core/thread_pool.hpp"

namespace wiw {

VectorEnv::VectorEnv(std::vector<NavigationEnv> envs) : envs_(std::move(envs)) {
  if (envs_.empty()) throw ArgumentError("VectorEnv: expected at least one environment");
  for (const NavigationEnv& env : envs_) {
    if (env.config().panorama != envs_[0].config().panorama || env.config().front != envs_[0].config().front) {
      throw ArgumentError("VectorEnv: all environments must have the same observation sizes");
    }
  }
}

void VectorEnv::step(std::span<const Action> actions, std::span<bool> moved) {
  if (actions.size() != envs_.size() || moved.size() != envs_.size()) {
    throw ArgumentError("VectorEnv.step: expected " + std::to_string(envs_.size()) + " actions, got " +
                        std::to_string(actions.size()));
  }
  parallel_for(envs_.size(), [&](std::size_t i) { moved[i] = envs_[i].step(actions[i]); });
}

void VectorEnv::observe(const ObservationTargets& targets) const {
  const std::size_t panorama = envs_[0].config().panorama.pixels();
  const std::size_t front = envs_[0].config().front.pixels();
  // A renderer spreads one view over all threads, so the views themselves go one after the other.
  for (std::size_t i = 0; i < envs_.size(); ++i) {
    envs_[i].observe({.panorama = targets.panorama != nullptr ? targets.panorama + i * panorama * 3 : nullptr,
                      .front = targets.front != nullptr ? targets.front + i * front * 3 : nullptr,
                      .depth = targets.depth != nullptr ? targets.depth + i * panorama : nullptr});
  }
}

}  // namespace wiw
