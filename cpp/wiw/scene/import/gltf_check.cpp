// SPDX-License-Identifier: Apache-2.0
#include "wiw/scene/import/gltf_check.hpp"

#include <algorithm>
#include <array>
#include <string_view>

#include "wiw/core/error.hpp"
#include "wiw/scene/import/gltf_layout.hpp"
#include "wiw/scene/import/gltf_nodes.hpp"

namespace wiw::scene {
namespace {

void check_version(const Json& root, const std::string& path) {
  const Json& version = root["asset"]["version"];
  if (version.text().starts_with("2.") || version.text() == "2" || version.whole() == 2U) return;
  throw FileError(path, "names no glTF version 2 in its asset; only version 2 is supported");
}

/// Extensions that are read, or that change only what is not drawn here, such as light. Others are refused where the
/// file needs them, and named in a warning elsewhere.
bool is_read(std::string_view extension) {
  constexpr std::array<std::string_view, 14> kRead{"KHR_draco_mesh_compression",
                                                   "EXT_meshopt_compression",
                                                   "KHR_texture_transform",
                                                   "KHR_texture_basisu",
                                                   "GOOGLE_texture_basis",
                                                   "EXT_texture_webp",
                                                   "KHR_lights_punctual",
                                                   "KHR_mesh_quantization",
                                                   "EXT_mesh_gpu_instancing",
                                                   "EXT_lights_image_based",
                                                   "EXT_lights_ies",
                                                   "KHR_animation_pointer",
                                                   "KHR_xmp_json_ld",
                                                   "KHR_xmp"};
  return extension.starts_with("KHR_materials_") || std::ranges::find(kRead, extension) != kRead.end();
}

void check_required(const Json& root, const std::string& path) {
  for (const Json& extension : root["extensionsRequired"].items()) {
    if (is_read(extension.text())) continue;
    throw FileError(path, "needs the glTF extension '" + std::string(extension.text()) +
                              "', which is not supported; export it without");
  }
}

}  // namespace

std::vector<std::string> check_gltf(const GltfDocument& document, const std::filesystem::path& path,
                                    const ImportLimits& limits) {
  const Json& root = document.root;
  check_version(root, path.string());
  check_required(root, path.string());
  check_gltf_layout(root, document.body, path.string());
  check_gltf_size(root, limits, path.string());
  std::vector<std::string> warnings;
  for (const Json& extension : root["extensionsUsed"].items()) {
    if (is_read(extension.text())) continue;
    warnings.push_back(path.filename().string() + " uses the glTF extension '" + std::string(extension.text()) +
                       "', which is not read; what it changes is not drawn");
  }
  return warnings;
}

}  // namespace wiw::scene
