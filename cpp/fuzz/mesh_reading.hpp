// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstdint>
#include <span>
#include <string>

#include "reading.hpp"
#include "wiw/scene/describe.hpp"
#include "wiw/scene/import.hpp"

namespace wiw::fuzz {

/// Reads bytes as a mesh file of such a name, and what it says of itself.
inline void read_mesh(const std::string& name, std::span<const std::uint8_t> bytes) {
  static const Folder folder;
  read_or_refuse(folder.write(name, bytes), [](const std::filesystem::path& file) {
    scene::ImportOptions options;
    options.limits = small_limits();
    const scene::ScenePtr scene = scene::load_mesh(file, options);
    scene->validate();
    scene::describe(*scene);
  });
}

}  // namespace wiw::fuzz
