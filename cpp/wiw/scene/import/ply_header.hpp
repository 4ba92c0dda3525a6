// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <filesystem>

namespace wiw::scene {

/// Reads the header of a PLY file and walks its binary body, because assimp's reader neither checks the one nor stops
/// at the end of the other. Throws FileError naming what is wrong.
void check_ply(const std::filesystem::path& path);

}  // namespace wiw::scene
