// SPDX-License-Identifier: Apache-2.0
// Binary glTF: its document and its binary chunk change apart.
#include "mesh_reading.hpp"
#include "mutation.hpp"

namespace {

using wiw::fuzz::append_number;
using wiw::fuzz::number_at;

constexpr std::size_t kHeader = 12, kChunkHeader = 8;
constexpr std::uint32_t kJsonChunk = 0x4E4F534A, kBinaryChunk = 0x004E4942;

std::vector<std::string> split(const std::string& bytes) {
  constexpr std::size_t kJson = kHeader + kChunkHeader;
  if (bytes.size() < kJson) return {};
  const std::size_t length = number_at<std::uint32_t>(bytes, kHeader);
  if (length > bytes.size() - kJson) return {};
  std::string json = bytes.substr(kJson, length);
  json.erase(json.find_last_not_of(' ') + 1);
  const std::size_t body = kJson + length + kChunkHeader;
  return {json, body < bytes.size() ? bytes.substr(body) : ""};
}

void append_chunk(std::string& bytes, std::uint32_t type, std::string content, char padding) {
  content.resize((content.size() + 3) / 4 * 4, padding);
  append_number(bytes, static_cast<std::uint32_t>(content.size()));
  append_number(bytes, type);
  bytes += content;
}

std::string join(const std::vector<std::string>& parts) {
  std::string chunks;
  append_chunk(chunks, kJsonChunk, parts[0], ' ');
  if (!parts[1].empty()) append_chunk(chunks, kBinaryChunk, parts[1], '\0');
  std::string bytes = "glTF";
  append_number(bytes, std::uint32_t{2});
  append_number(bytes, static_cast<std::uint32_t>(kHeader + chunks.size()));
  return bytes + chunks;
}

}  // namespace

wiw::fuzz::Container wiw::fuzz::container() { return {.split = split, .join = join, .json = 0}; }

extern "C" int LLVMFuzzerTestOneInput(const std::uint8_t* data, std::size_t size) {
  wiw::fuzz::read_mesh("m.glb", {data, size});
  return 0;
}
