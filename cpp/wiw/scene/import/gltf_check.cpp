// SPDX-License-Identifier: Apache-2.0
#include "wiw/scene/import/gltf_check.hpp"

#include <algorithm>
#include <array>
#include <cstring>
#include <initializer_list>
#include <optional>
#include <string_view>

#include "wiw/core/error.hpp"
#include "wiw/scene/import/file.hpp"
#include "wiw/scene/import/gltf_layout.hpp"
#include "wiw/scene/import/json.hpp"

namespace wiw {
namespace {

constexpr std::size_t kChunkHeader = 8;  // length, type

std::uint32_t word_at(const std::vector<std::uint8_t>& bytes, std::size_t offset) {
  std::uint32_t value = 0;  // glTF is little-endian, and so is every machine this builds for
  std::memcpy(&value, bytes.data() + offset, sizeof(value));
  return value;
}

/// What a file says of itself, and the length of a GLB's binary chunk if it has one.
struct Document {
  Json root;
  std::optional<std::size_t> body;
};

Json parsed(const std::vector<std::uint8_t>& bytes, const std::string& path) {
  try {
    return Json::parse({reinterpret_cast<const char*>(bytes.data()), bytes.size()});
  } catch (const Error& error) {
    throw FileError(path, error.what());
  }
}

Document glb_document(const std::filesystem::path& path) {
  constexpr std::size_t kHeader = 12 + kChunkHeader;  // magic, version, length; the JSON chunk's
  const std::size_t size = size_of_file(path);
  const auto header = read_file(path, kHeader);
  if (header.size() < kHeader) throw FileError(path.string(), "ends within its header (truncated file)");
  if (word_at(header, 4) != 2) {
    throw FileError(path.string(),
                    "is glTF version " + std::to_string(word_at(header, 4)) + "; only version 2 is supported");
  }
  if (word_at(header, 8) > size) {
    throw FileError(path.string(), "should have " + std::to_string(word_at(header, 8)) + " bytes but has " +
                                       std::to_string(size) + " (truncated file)");
  }
  const std::size_t length = word_at(header, 12);
  if (length > size - kHeader || word_at(header, 16) != 0x4E4F534A) {
    throw FileError(path.string(), "has no valid JSON chunk (damaged file)");
  }
  const std::size_t next = (kHeader + length + 3) / 4 * 4;
  auto bytes = read_file(path, next + kChunkHeader);
  std::optional<std::size_t> body;
  if (bytes.size() == next + kChunkHeader && word_at(bytes, next + 4) == 0x004E4942) body = word_at(bytes, next);
  if (body && *body > size - next - kChunkHeader) {
    throw FileError(path.string(), "has a binary chunk that ends behind the file (truncated file)");
  }
  bytes.resize(kHeader + length);
  bytes.erase(bytes.begin(), bytes.begin() + kHeader);
  return {parsed(bytes, path.string()), body};
}

Document document_of(const std::filesystem::path& path, MeshFormat format) {
  if (format == MeshFormat::kGlb) return glb_document(path);
  return {parsed(read_file(path), path.string()), std::nullopt};
}

/// assimp would hand another version to its reader of glTF 1, whose layout is not checked here.
void check_version(const Json& root, const std::string& path) {
  const Json& version = root["asset"]["version"];
  if (version.text().starts_with("2.") || version.text() == "2" || version.whole() == 2U) return;
  throw FileError(path, "names no glTF version 2 in its asset; only version 2 is supported");
}

/// Extensions that assimp reads, that change only how light is reflected, or that are named in a warning.
constexpr std::array<std::string_view, 6> kReadExtensions{"KHR_draco_mesh_compression", "KHR_texture_transform",
                                                          "KHR_texture_basisu",         "GOOGLE_texture_basis",
                                                          "EXT_texture_webp",           "KHR_lights_punctual"};

bool is_read(std::string_view extension) {
  return extension.starts_with("KHR_materials_") ||
         std::ranges::find(kReadExtensions, extension) != kReadExtensions.end();
}

void check_required(const Json& root, const std::string& path) {
  for (const Json& extension : root["extensionsRequired"].items()) {
    if (is_read(extension.text())) continue;
    throw FileError(path, "needs the glTF extension '" + std::string(extension.text()) +
                              "', which is not supported; export it without");
  }
}

void check_images(const Json& root, const std::string& path) {
  for (const Json& image : root["images"].items()) {
    const Json& type = image["mimeType"];
    if (type.is_null() || type.text().starts_with("image/") || type.text().starts_with("application/")) continue;
    throw FileError(path, "has an image of unknown type (damaged file)");
  }
}

}  // namespace

std::vector<std::string> check_gltf(const std::filesystem::path& path, MeshFormat format) {
  const auto [root, body] = document_of(path, format);
  check_version(root, path.string());
  check_required(root, path.string());
  check_images(root, path.string());
  check_gltf_layout(root, body, path.string());

  std::vector<std::string> warnings;
  const auto count = [&](std::initializer_list<const char*> extensions, const char* format_name) {
    std::size_t textures = 0;
    for (const Json& texture : root["textures"].items()) {
      for (const char* extension : extensions) textures += texture["extensions"][extension].is_null() ? 0 : 1;
    }
    if (textures == 0) return;
    warnings.push_back(
        std::to_string(textures) + " textures of " + path.filename().string() + " are stored as " + format_name +
        ", which cannot be decoded here; drawn without texture unless the file holds a PNG or JPEG beside it");
  };
  count({"KHR_texture_basisu", "GOOGLE_texture_basis"}, "Basis Universal");
  count({"EXT_texture_webp"}, "WebP");
  return warnings;
}

}  // namespace wiw
