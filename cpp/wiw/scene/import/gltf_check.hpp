// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <filesystem>

#include "wiw/scene/import.hpp"
#include "wiw/scene/import/gltf_rewrite.hpp"
#include "wiw/scene/import/mesh_format.hpp"

namespace wiw::scene {

/// Checks the parts of a GLB or glTF file that assimp takes for granted, and rewrites what assimp would drop or draw
/// wrong (see `rewrite_gltf`). What cannot be drawn is named in warnings: textures that hold no PNG or JPEG, counted,
/// and extensions that nobody reads. Throws FileError for chunks that do not fit the file's length, accessors that
/// reach beyond their buffers, nodes that grow without bound, images of no known type, required extensions that are not
/// read and versions other than 2.
GltfRewrite check_gltf(const std::filesystem::path& path, MeshFormat format, const ImportOptions& options);

}  // namespace wiw::scene
