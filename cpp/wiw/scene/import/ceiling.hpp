// SPDX-License-Identifier: Apache-2.0
#pragma once

#include "wiw/scene/scene.hpp"

namespace wiw::scene {

/// Closes a scene that is open above: one instance "ceiling" of category "ceiling", a white rectangle over the bounds
/// of the scene, `height` metres above its floor. It faces down, so no navigation mesh takes its top for a floor.
/// The floor is the top of the instances of category "floor", or the scene's lowest point if there are none.
void add_ceiling(Scene& scene, float height);

}  // namespace wiw::scene
