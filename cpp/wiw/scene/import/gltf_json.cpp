// SPDX-License-Identifier: Apache-2.0
#include "wiw/scene/import/gltf_json.hpp"

#include <algorithm>
#include <array>
#include <cstring>
#include <initializer_list>
#include <string_view>

#include "wiw/core/error.hpp"
#include "wiw/scene/import/file.hpp"

namespace wiw {
namespace {

std::uint32_t word_at(const std::vector<std::uint8_t>& bytes, std::size_t offset) {
  std::uint32_t value = 0;  // glTF is little-endian, and so is every machine this builds for
  std::memcpy(&value, bytes.data() + offset, sizeof(value));
  return value;
}

/// The JSON of a file: all of a .gltf, the first chunk of a .glb.
std::vector<std::uint8_t> json_of(const std::filesystem::path& path, MeshFormat format) {
  if (format == MeshFormat::kGltf) return read_file(path);
  constexpr std::size_t kHeader = 20;  // magic, version, length; JSON length, JSON type
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
  auto bytes = read_file(path, kHeader + length);
  bytes.erase(bytes.begin(), bytes.begin() + kHeader);
  return bytes;
}

/// Calls use(text behind the colon) wherever `name` (with its quotes) is an object's key. Names in extensionsUsed are
/// array elements, so no colon follows them.
template <class Use>
void for_each_key(std::string_view json, std::string_view name, const Use& use) {
  constexpr std::string_view kSpace = " \t\r\n";
  for (std::size_t at = json.find(name); at != std::string_view::npos; at = json.find(name, at + 1)) {
    const std::size_t colon = json.find_first_not_of(kSpace, at + name.size());
    if (colon == std::string_view::npos || json[colon] != ':') continue;
    const std::size_t value = json.find_first_not_of(kSpace, colon + 1);
    use(value == std::string_view::npos ? std::string_view() : json.substr(value));
  }
}

/// Extensions that assimp reads, that change only how light is reflected, or that are named in a warning.
constexpr std::array<std::string_view, 6> kReadExtensions{"KHR_draco_mesh_compression", "KHR_texture_transform",
                                                          "KHR_texture_basisu",         "GOOGLE_texture_basis",
                                                          "EXT_texture_webp",           "KHR_lights_punctual"};

bool is_read(std::string_view extension) {
  return extension.starts_with("KHR_materials_") ||
         std::ranges::find(kReadExtensions, extension) != kReadExtensions.end();
}

/// `list` begins at the value of "extensionsRequired": an array of strings.
void check_required(std::string_view list, const std::string& path) {
  const std::string_view array = list.substr(0, list.find(']'));
  for (std::size_t open = array.find('"'); open != std::string_view::npos; open = array.find('"', open)) {
    const std::size_t close = std::min(array.find('"', open + 1), array.size());
    const std::string_view extension = array.substr(open + 1, close - open - 1);
    if (!is_read(extension)) {
      throw FileError(
          path, "needs the glTF extension '" + std::string(extension) + "', which is not supported; export it without");
    }
    open = std::min(close + 1, array.size());
  }
}

}  // namespace

std::vector<std::string> check_gltf(const std::filesystem::path& path, MeshFormat format) {
  const auto bytes = json_of(path, format);
  const std::string_view json(reinterpret_cast<const char*>(bytes.data()), bytes.size());
  for_each_key(json, "\"mimeType\"", [&](std::string_view value) {
    if (value.starts_with("\"image/") || value.starts_with("\"application/")) return;
    throw FileError(path.string(), "has an image of unknown type (damaged file)");
  });
  for_each_key(json, "\"extensionsRequired\"", [&](std::string_view value) { check_required(value, path.string()); });

  std::vector<std::string> warnings;
  const auto count = [&](std::initializer_list<const char*> extensions, const char* format_name) {
    std::size_t textures = 0;
    for (const char* extension : extensions) for_each_key(json, extension, [&](std::string_view) { ++textures; });
    if (textures == 0) return;
    warnings.push_back(
        std::to_string(textures) + " textures of " + path.filename().string() + " are stored as " + format_name +
        ", which cannot be decoded here; drawn without texture unless the file holds a PNG or JPEG beside it");
  };
  count({"\"KHR_texture_basisu\"", "\"GOOGLE_texture_basis\""}, "Basis Universal");
  count({"\"EXT_texture_webp\""}, "WebP");
  return warnings;
}

}  // namespace wiw
