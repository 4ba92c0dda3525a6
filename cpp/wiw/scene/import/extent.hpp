// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <filesystem>

#include "wiw/scene/scene.hpp"

namespace wiw::scene {

/// What Scene::validate asks, and that everything lies within 10^7 units of the origin: beyond, a file is damaged or
/// its numbers have overflowed. (Maps in UTM reach 10^7 m, where float32 still tells metres apart.) Throws FileError.
void check_imported(const Scene& scene, const std::filesystem::path& path);

}  // namespace wiw::scene
