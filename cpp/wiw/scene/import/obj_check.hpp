// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <filesystem>

namespace wiw::scene {

/// Checks the material files of an OBJ file: assimp follows a texture that belongs to no material into nowhere. Throws
/// FileError naming the material file and its line.
void check_obj(const std::filesystem::path& path);

}  // namespace wiw::scene
