// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <vector>

#include "wiw/env/navigation_env.hpp"

namespace wiw::testing {

/// A floor of 6 x 4 m, x and z from 0, with a block over x in [2.5, 3.5] and z in [2, 4], and coloured boards around.
/// `shade` tells worlds apart.
env::NavigationWorld make_world(float shade);

/// Small pictures, so that drawing takes no time.
env::NavigationConfig small_pictures(env::Motion motion = env::Motion::kRefuse);

/// Everything that one observation, or N of them, is written into.
struct Pictures {
  explicit Pictures(const env::NavigationConfig& config, std::size_t count = 1);
  env::ObservationTargets targets();
  bool operator==(const Pictures&) const = default;

  std::vector<std::uint8_t> panorama, front;
  std::vector<float> depth;
};

}  // namespace wiw::testing
