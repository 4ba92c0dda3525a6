// SPDX-License-Identifier: Apache-2.0
#pragma once

#include "wiw/scene/scene.hpp"

namespace wiw::scene {

/// Merges vertices whose every attribute is equal and drops those that no triangle uses: some formats repeat a vertex
/// for each of its faces.
Mesh weld(const Mesh& mesh);

}  // namespace wiw::scene
