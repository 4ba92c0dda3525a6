// SPDX-License-Identifier: Apache-2.0
#include "wiw/scene/import/gltf_check.hpp"

#include <algorithm>
#include <array>
#include <map>
#include <string>
#include <string_view>
#include <vector>

#include "wiw/core/error.hpp"
#include "wiw/scene/import/gltf_document.hpp"
#include "wiw/scene/import/gltf_layout.hpp"
#include "wiw/scene/import/gltf_nodes.hpp"
#include "wiw/scene/import/json.hpp"

namespace wiw::scene {
namespace {

/// assimp would hand another version to its reader of glTF 1, whose layout is not checked here.
void check_version(const Json& root, const std::string& path) {
  const Json& version = root["asset"]["version"];
  if (version.text().starts_with("2.") || version.text() == "2" || version.whole() == 2U) return;
  throw FileError(path, "names no glTF version 2 in its asset; only version 2 is supported");
}

/// Extensions that are read, or that change only what is not drawn here, such as light. Others are refused where the
/// file needs them, and named in a warning elsewhere.
bool is_read(std::string_view extension) {
  constexpr std::array<std::string_view, 13> kRead{"KHR_draco_mesh_compression",
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

void warn_of_extensions(const Json& root, const std::filesystem::path& path, std::vector<std::string>& warnings) {
  for (const Json& extension : root["extensionsUsed"].items()) {
    if (is_read(extension.text())) continue;
    warnings.push_back(path.filename().string() + " uses the glTF extension '" + std::string(extension.text()) +
                       "', which is not read; what it changes is not drawn");
  }
}

/// How a texture without an image that can be decoded is stored; empty for any other.
std::string_view undecodable_encoding(const Json& texture) {
  const auto has = [&](const char* name) { return !texture["extensions"][name].is_null(); };
  if (!texture["source"].is_null()) return {};
  if (has("KHR_texture_basisu") || has("GOOGLE_texture_basis")) return "Basis Universal";
  return has("EXT_texture_webp") ? "WebP" : std::string_view();
}

void warn_of_textures(const Json& root, const std::filesystem::path& path, std::vector<std::string>& warnings) {
  std::map<std::string_view, std::size_t> counts;
  for (const Json& texture : root["textures"].items()) ++counts[undecodable_encoding(texture)];
  for (const auto& [encoding, count] : counts) {
    if (encoding.empty()) continue;
    warnings.push_back(std::to_string(count) + " textures of " + path.filename().string() + " are stored as " +
                       std::string(encoding) +
                       " alone, which cannot be decoded here; drawn without texture (export them as "
                       "PNG or JPEG, or with one of these beside it)");
  }
}

std::vector<std::size_t> untextured_materials(const Json& root) {
  std::vector<std::size_t> untextured;
  const auto& materials = root["materials"].items();
  const auto& textures = root["textures"].items();
  for (std::size_t i = 0; i < materials.size(); ++i) {
    const auto index = texture_to_draw(materials[i])["index"].whole();
    if (index && *index < textures.size() && !undecodable_encoding(textures[*index]).empty()) untextured.push_back(i);
  }
  return untextured;
}

void check_images(const Json& root, const std::string& path) {
  for (const Json& image : root["images"].items()) {
    const Json& type = image["mimeType"];
    if (type.is_null() || type.text().starts_with("image/") || type.text().starts_with("application/")) continue;
    throw FileError(path, "has an image of unknown type (damaged file)");
  }
}

}  // namespace

GltfRewrite check_gltf(const std::filesystem::path& path, MeshFormat format, const ImportOptions& options) {
  const GltfDocument document = read_gltf_document(path, format);
  const Json& root = document.root;
  check_version(root, path.string());
  check_required(root, path.string());
  check_images(root, path.string());
  check_gltf_layout(root, document.body, path.string());
  check_gltf_size(root, options.limits, path.string());
  GltfRewrite rewrite = rewrite_gltf(document, path, format, options);
  warn_of_extensions(root, path, rewrite.warnings);
  warn_of_textures(root, path, rewrite.warnings);
  rewrite.untextured = untextured_materials(root);
  return rewrite;
}

}  // namespace wiw::scene
