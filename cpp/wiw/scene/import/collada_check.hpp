// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <filesystem>

namespace wiw::scene {

/// Checks a DAE file for well-formed XML and for the attributes that the COLLADA schema requires of the elements
/// assimp reads, because assimp takes them for granted. Throws FileError naming what is wrong.
void check_collada(const std::filesystem::path& path);

}  // namespace wiw::scene
