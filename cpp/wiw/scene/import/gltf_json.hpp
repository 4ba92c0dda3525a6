// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstddef>
#include <filesystem>

#include "wiw/scene/import/mesh_format.hpp"

namespace wiw {

/// Number of textures that a glTF file stores in Basis Universal (KHR_texture_basisu or GOOGLE_texture_basis), which
/// assimp drops without a word. Throws FileError for a GLB whose chunks do not fit its length.
std::size_t count_basis_textures(const std::filesystem::path& path, MeshFormat format);

}  // namespace wiw
