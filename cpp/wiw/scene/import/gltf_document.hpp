// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstddef>
#include <cstdint>
#include <filesystem>
#include <optional>
#include <vector>

#include "wiw/scene/import/json.hpp"
#include "wiw/scene/import/mesh_format.hpp"

namespace wiw::scene {

/// What a glTF file says of itself, and where a GLB's binary chunk lies if it has one.
struct GltfDocument {
  Json root;
  std::optional<std::size_t> body;  // bytes
  std::size_t body_offset = 0;
};

/// Throws FileError for chunks that do not fit the file's length and for JSON that is none.
GltfDocument read_gltf_document(const std::filesystem::path& path, MeshFormat format);

/// A GLB's binary chunk.
std::vector<std::uint8_t> read_gltf_body(const GltfDocument& document, const std::filesystem::path& path);

}  // namespace wiw::scene
