// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <filesystem>
#include <string>
#include <vector>

#include "wiw/scene/import/mesh_format.hpp"

namespace wiw {

/// Checks the parts of a GLB or glTF file that assimp takes for granted, and returns warnings about textures that it
/// drops without a word (Basis Universal, WebP), counted. Throws FileError for chunks that do not fit the file's
/// length, accessors that reach beyond their buffers, images of no known type, required extensions that are not read
/// and versions other than 2.
std::vector<std::string> check_gltf(const std::filesystem::path& path, MeshFormat format);

}  // namespace wiw
