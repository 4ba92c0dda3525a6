// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstdint>
#include <filesystem>
#include <map>
#include <string>
#include <vector>

#include "wiw/scene/import.hpp"
#include "wiw/scene/import/gltf_document.hpp"

namespace wiw::scene {

/// Contents that stand in for files, by file name.
using FileContents = std::map<std::string, std::vector<std::uint8_t>>;

struct GltfRewrite {
  FileContents files;  // none: assimp may read the file as it is
  std::vector<std::string> warnings;
  std::vector<std::size_t> untextured;  // materials whose texture has no image that can be decoded
};

/// Says in plain glTF 2.0 what assimp would drop or draw wrong: texture transforms and the choice of texture
/// coordinates are carried out on the coordinates, quantised and interleaved values become floats that lie densely,
/// instances become nodes, morph weights and skins are applied as they are at rest, and names of buffers lose their
/// percent escapes. What the renderers cannot draw is named in a warning.
GltfRewrite rewrite_gltf(const GltfDocument& document, const std::filesystem::path& path, MeshFormat format,
                         const ImportOptions& options);

/// The texture that is drawn of a material: its base colour, its emission where there is no other.
const Json& texture_to_draw(const Json& material);

/// Whether a glTF material's base colour is black and its emission is not.
bool is_emissive_only(const Json& material);

}  // namespace wiw::scene
