// SPDX-License-Identifier: Apache-2.0
#include "wiw/env/vector_env.hpp"

#include "wiw/core/error.hpp"
#include "wiw/core/thread_pool.hpp"

namespace wiw::env {

namespace {

void expect_alike(const NavigationConfig& one, const NavigationConfig& other) {
  if (one.panorama != other.panorama || one.front != other.front || one.front_hfov != other.front_hfov) {
    throw ArgumentError("VectorEnv: all environments must have the same observation sizes and field of view");
  }
}

}  // namespace

VectorEnv::VectorEnv(std::vector<NavigationEnv> envs) : envs_(std::move(envs)) {
  if (envs_.empty()) throw ArgumentError("VectorEnv: expected at least one environment");
  for (const NavigationEnv& env : envs_) expect_alike(env.config(), envs_[0].config());
}

void VectorEnv::replace(std::size_t i, const NavigationEnv& env) {
  NavigationEnv& place = envs_.at(i);
  expect_alike(env.config(), place.config());
  place = env;
}

void VectorEnv::step(std::span<const action::Action> actions, std::span<bool> moved) {
  if (actions.size() != envs_.size() || moved.size() != envs_.size()) {
    throw ArgumentError("VectorEnv.step: expected " + std::to_string(envs_.size()) + " actions, got " +
                        std::to_string(actions.size()));
  }
  parallel_for(envs_.size(), [&](std::size_t i) { moved[i] = envs_[i].step(actions[i]); });
}

void VectorEnv::observe(const ObservationTargets& targets) const {
  const std::size_t panorama = envs_[0].config().panorama.pixels();
  const std::size_t front = envs_[0].config().front.pixels();
  const auto at = [](auto* base, std::size_t offset) { return base == nullptr ? nullptr : base + offset; };
  for (std::size_t first = 0, last; first < envs_.size(); first = last) {
    last = first + 1;
    while (last < envs_.size() && envs_[last].world().renderer == envs_[first].world().renderer) ++last;
    env::observe(std::span(envs_).subspan(first, last - first),
                 {.panorama = at(targets.panorama, first * panorama * 3),
                  .front = at(targets.front, first * front * 3),
                  .depth = at(targets.depth, first * panorama),
                  .panorama_ids = at(targets.panorama_ids, first * panorama),
                  .front_ids = at(targets.front_ids, first * front)});
  }
}

}  // namespace wiw::env
