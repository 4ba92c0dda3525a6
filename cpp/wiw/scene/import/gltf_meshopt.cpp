// SPDX-License-Identifier: Apache-2.0
#include "wiw/scene/import/gltf_meshopt.hpp"

#include <meshoptimizer.h>

#include <string_view>

#include "wiw/core/error.hpp"

namespace wiw::scene {
namespace {

/// Most decoded bytes for each encoded one: a block of 256 zeros takes at least a quarter of a byte in any version of
/// the format. What claims more is damaged, and is refused before memory is taken for it.
constexpr std::size_t kMostExpansion = 1024;

/// Sizes that meshoptimizer takes for granted.
bool is_valid(std::string_view mode, std::string_view filter, std::size_t count, std::size_t stride) {
  if (mode == "TRIANGLES" || mode == "INDICES") {
    const bool is_whole = mode == "INDICES" || count % 3 == 0;
    return (filter.empty() || filter == "NONE") && (stride == 2 || stride == 4) && is_whole;
  }
  if (mode != "ATTRIBUTES" || stride == 0 || stride % 4 != 0 || stride > 256) return false;
  if (filter == "OCTAHEDRAL") return stride == 4 || stride == 8;
  if (filter == "QUATERNION") return stride == 8;
  return filter.empty() || filter == "NONE" || filter == "EXPONENTIAL";
}

bool decode(std::string_view mode, std::size_t count, std::size_t stride, std::span<const std::uint8_t> encoded,
            std::uint8_t* decoded) {
  if (mode == "ATTRIBUTES") {
    return meshopt_decodeVertexBuffer(decoded, count, stride, encoded.data(), encoded.size()) == 0;
  }
  if (mode == "TRIANGLES") {
    return meshopt_decodeIndexBuffer(decoded, count, stride, encoded.data(), encoded.size()) == 0;
  }
  return meshopt_decodeIndexSequence(decoded, count, stride, encoded.data(), encoded.size()) == 0;
}

void apply_filter(std::string_view filter, std::size_t count, std::size_t stride, std::uint8_t* decoded) {
  if (filter == "OCTAHEDRAL") meshopt_decodeFilterOct(decoded, count, stride);
  if (filter == "QUATERNION") meshopt_decodeFilterQuat(decoded, count, stride);
  if (filter == "EXPONENTIAL") meshopt_decodeFilterExp(decoded, count, stride);
}

}  // namespace

std::vector<std::uint8_t> decode_meshopt(const Json& extension, std::span<const std::uint8_t> encoded,
                                         const std::filesystem::path& path) {
  const std::string_view mode = extension["mode"].text();
  const std::string_view filter = extension["filter"].text();
  const std::size_t count = extension["count"].whole().value_or(0);
  const std::size_t stride = extension["byteStride"].whole().value_or(0);
  if (!is_valid(mode, filter, count, stride)) {
    throw FileError(path.string(), "has a compressed bufferView of mode '" + std::string(mode) + "', filter '" +
                                       std::string(filter) + "', " + std::to_string(count) + " x " +
                                       std::to_string(stride) +
                                       " bytes, which EXT_meshopt_compression does not have (damaged file)");
  }
  if (count * stride / kMostExpansion > encoded.size()) {
    throw FileError(path.string(), "has a bufferView of " + std::to_string(encoded.size()) +
                                       " bytes that cannot hold its " + std::to_string(count) + " x " +
                                       std::to_string(stride) + " bytes (damaged file)");
  }
  std::vector<std::uint8_t> decoded(count * stride);
  if (!decode(mode, count, stride, encoded, decoded.data())) {
    throw FileError(path.string(), "has a bufferView that EXT_meshopt_compression cannot decode (damaged file)");
  }
  apply_filter(filter, count, stride, decoded.data());
  return decoded;
}

}  // namespace wiw::scene
