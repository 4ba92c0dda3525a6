// SPDX-License-Identifier: Apache-2.0
#include "wiw/scene/import/gltf_document.hpp"

#include <cstring>
#include <string>

#include "wiw/core/error.hpp"
#include "wiw/scene/import/file.hpp"

namespace wiw::scene {
namespace {

constexpr std::size_t kChunkHeader = 8;  // length, type
constexpr std::uint32_t kJsonChunk = 0x4E4F534A;
constexpr std::uint32_t kBinaryChunk = 0x004E4942;

std::uint32_t word_at(const std::vector<std::uint8_t>& bytes, std::size_t offset) {
  std::uint32_t value = 0;  // glTF is little-endian, and so is every machine this builds for
  std::memcpy(&value, bytes.data() + offset, sizeof(value));
  return value;
}

Json parsed(const std::vector<std::uint8_t>& bytes, const std::string& path) {
  try {
    return Json::parse({reinterpret_cast<const char*>(bytes.data()), bytes.size()});
  } catch (const Error& error) {
    throw FileError(path, error.what());
  }
}

GltfDocument glb_document(const std::filesystem::path& path) {
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
  if (length > size - kHeader || word_at(header, 16) != kJsonChunk) {
    throw FileError(path.string(), "has no valid JSON chunk (damaged file)");
  }
  const std::size_t next = (kHeader + length + 3) / 4 * 4;
  auto bytes = read_file(path, next + kChunkHeader);
  std::optional<std::size_t> body;
  if (bytes.size() == next + kChunkHeader && word_at(bytes, next + 4) == kBinaryChunk) body = word_at(bytes, next);
  if (body && *body > size - next - kChunkHeader) {
    throw FileError(path.string(), "has a binary chunk that ends behind the file (truncated file)");
  }
  bytes.resize(kHeader + length);
  bytes.erase(bytes.begin(), bytes.begin() + kHeader);
  return {parsed(bytes, path.string()), body, next + kChunkHeader};
}

}  // namespace

GltfDocument read_gltf_document(const std::filesystem::path& path, MeshFormat format) {
  if (format == MeshFormat::kGlb) return glb_document(path);
  return {parsed(read_file(path), path.string()), std::nullopt};
}

std::vector<std::uint8_t> read_gltf_body(const GltfDocument& document, const std::filesystem::path& path) {
  auto bytes = read_file(path, document.body_offset + document.body.value_or(0));
  bytes.erase(bytes.begin(), bytes.begin() + static_cast<std::ptrdiff_t>(document.body_offset));
  return bytes;
}

}  // namespace wiw::scene
