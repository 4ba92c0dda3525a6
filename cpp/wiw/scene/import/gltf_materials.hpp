// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <array>
#include <cstddef>
#include <filesystem>
#include <optional>

#include "wiw/scene/import.hpp"
#include "wiw/scene/import/gltf_data.hpp"

namespace wiw::scene {

/// How a material's texture lies on its meshes: which texture coordinates it takes, and
///   u, v -> offset + R(rotation) S(scale) (u, v), counter-clockwise where v points down.
struct TexturePlacement {
  std::size_t set = 0;  // TEXCOORD_0
  std::array<float, 2> offset{0, 0};
  std::array<float, 2> scale{1, 1};
  float rotation = 0;  // radians

  void apply(float* uv) const;
};

/// The placement of the texture that is drawn of a material; nothing if it has none.
std::optional<TexturePlacement> texture_placement(const Json& material);

/// Materials and textures of the document, in its order. What is drawn of a material is its base colour, or its
/// emission where the base colour is black.
void convert_gltf_materials(const Json& document, GltfData& data, const std::filesystem::path& path,
                            const ImportOptions& options, Scene& scene);

}  // namespace wiw::scene
