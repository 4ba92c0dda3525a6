// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstdint>
#include <span>

#include "wiw/core/rng.hpp"

namespace wiw {

/// One seed a candidate, a function of its place in the run alone: neither batching nor the order of episodes matters.
inline void candidate_seeds(std::uint64_t run_seed, std::uint64_t episode, std::uint64_t decision,
                            std::span<std::uint64_t> seeds) {
  for (std::size_t i = 0; i < seeds.size(); ++i) seeds[i] = fold_key({run_seed, episode, decision, i});
}

}  // namespace wiw
