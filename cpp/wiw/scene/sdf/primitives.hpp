// SPDX-License-Identifier: Apache-2.0
#pragma once

#include "wiw/scene/scene.hpp"
#include "wiw/scene/sdf/world.hpp"

namespace wiw::scene::sdf {

/// Triangles of a box, sphere, cylinder (along z) or plane, centred on the origin, Z up, with normals.
Mesh primitive_mesh(const Geometry& geometry);

}  // namespace wiw::scene::sdf
