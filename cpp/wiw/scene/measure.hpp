// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstddef>

#include "wiw/scene/scene.hpp"

namespace wiw::scene {

/// Box around one placed object, in the world.
Eigen::AlignedBox3f instance_bounds(const Scene& scene, const Instance& instance);

/// Memory of the decoded textures, and of the vertex and triangle arrays.
std::size_t texture_bytes(const Scene& scene);
std::size_t mesh_bytes(const Scene& scene);

/// Share of the surface, over placements, whose texture could not be had: 0 to 1.
double missing_texture_share(const Scene& scene);

}  // namespace wiw::scene
