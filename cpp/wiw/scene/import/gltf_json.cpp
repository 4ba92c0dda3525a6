// SPDX-License-Identifier: Apache-2.0
#include "wiw/scene/import/gltf_json.hpp"

#include <cstring>
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

}  // namespace

std::size_t check_gltf(const std::filesystem::path& path, MeshFormat format) {
  const auto bytes = json_of(path, format);
  const std::string_view json(reinterpret_cast<const char*>(bytes.data()), bytes.size());
  for_each_key(json, "\"mimeType\"", [&](std::string_view value) {
    if (value.starts_with("\"image/") || value.starts_with("\"application/")) return;
    throw FileError(path.string(), "has an image of unknown type (damaged file)");
  });
  std::size_t basis_textures = 0;
  for (const char* extension : {"\"KHR_texture_basisu\"", "\"GOOGLE_texture_basis\""}) {
    for_each_key(json, extension, [&](std::string_view) { ++basis_textures; });
  }
  return basis_textures;
}

}  // namespace wiw
