// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <Eigen/Geometry>
#include <cstdint>
#include <span>

#include "wiw/scene/labels.hpp"
#include "wiw/scene/scene.hpp"

namespace wiw::scene {

/// Adds a part's textures, materials and warnings to a scene; returns the index of the part's first material there.
std::int32_t add_appearance(const Scene& part, Scene& scene);

/// A model's place in a scene; an instance may have several.
struct Placement {
  std::uint32_t part = 0;
  std::uint32_t instance = 0;                                  // Instance::id, from 1
  Eigen::Affine3f T_world_part = Eigen::Affine3f::Identity();  // may scale and mirror
};

/// One scene of several, with their textures, materials and warnings. Each placed part goes to the instance that its
/// placement names; instances of the parts themselves are dissolved. Throws ArgumentError for a placement of no part
/// or no instance.
ScenePtr assemble(std::span<const ScenePtr> parts, std::span<const Placement> placements, SceneLabels labels);

}  // namespace wiw::scene
