// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <string>

#include "wiw/scene/scene.hpp"

namespace wiw::scene {

/// One line: name, placements, triangles, size.
std::string summary(const Scene& scene);

/// The summary, then attributes, categories with their counts, memory and warnings, a line each.
std::string describe(const Scene& scene);

}  // namespace wiw::scene
