// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstddef>
#include <filesystem>

#include "wiw/scene/import/mesh_format.hpp"

namespace wiw {

/// Checks the parts of a GLB or glTF file that assimp takes for granted, and returns the number of textures stored in
/// Basis Universal (KHR_texture_basisu or GOOGLE_texture_basis), which assimp drops without a word. Throws FileError
/// for chunks that do not fit the file's length and for images of no known type.
std::size_t check_gltf(const std::filesystem::path& path, MeshFormat format);

}  // namespace wiw
