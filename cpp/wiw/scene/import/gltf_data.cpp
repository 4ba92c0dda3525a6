// SPDX-License-Identifier: Apache-2.0
#include "wiw/scene/import/gltf_data.hpp"

#include <algorithm>
#include <array>
#include <charconv>
#include <cstring>

#include "wiw/core/error.hpp"
#include "wiw/scene/import/file.hpp"
#include "wiw/scene/import/gltf_meshopt.hpp"
#include "wiw/scene/import/gltf_nodes.hpp"

namespace wiw::scene {
namespace {

struct ComponentType {
  std::uint64_t code;
  std::size_t bytes;
  float most;  // of the integer, which is 1 where it is normalised
};
constexpr std::uint64_t kFloat = 5126;
constexpr std::size_t kMostZeroRows = 10'000'000;  // of an accessor that has no bytes but those of its changes
constexpr std::array<ComponentType, 6> kComponents{
    {{5120, 1, 127.f}, {5121, 1, 255.f}, {5122, 2, 32767.f}, {5123, 2, 65535.f}, {5125, 4, 1.f}, {kFloat, 4, 1.f}}};

template <class T>
float number_at(const std::uint8_t* bytes) {
  T value;
  std::memcpy(&value, bytes, sizeof(value));
  return static_cast<float>(value);
}

float number_of(const std::uint8_t* bytes, std::uint64_t code) {
  switch (code) {
    case 5120: return number_at<std::int8_t>(bytes);
    case 5121: return number_at<std::uint8_t>(bytes);
    case 5122: return number_at<std::int16_t>(bytes);
    case 5123: return number_at<std::uint16_t>(bytes);
    case 5125: return number_at<std::uint32_t>(bytes);
    default: return number_at<float>(bytes);
  }
}

/// A base64 text; what is none of its letters ends it.
std::vector<std::uint8_t> decode_base64(std::string_view text) {
  constexpr std::string_view kLetters = "ABCDEFGHIJKLMNOPQRSTUVWXYZabcdefghijklmnopqrstuvwxyz0123456789+/";
  constexpr std::uint8_t kNone = 64;
  std::array<std::uint8_t, 256> values{};
  values.fill(kNone);
  for (std::size_t i = 0; i < kLetters.size(); ++i) {
    values[static_cast<unsigned char>(kLetters[i])] = static_cast<std::uint8_t>(i);
  }
  std::vector<std::uint8_t> bytes;
  bytes.reserve(text.size() / 4 * 3);
  std::uint32_t bits = 0;
  unsigned count = 0;
  for (const char letter : text) {
    const std::uint8_t value = values[static_cast<unsigned char>(letter)];
    if (value == kNone) break;
    bits = bits << 6U | value;
    count += 6;
    if (count < 8) continue;
    count -= 8;
    bytes.push_back(static_cast<std::uint8_t>(bits >> count));
  }
  return bytes;
}

const Json& compression_of(const Json& view) { return view["extensions"]["EXT_meshopt_compression"]; }

}  // namespace

/// Where the rows of an accessor, or the entries of its sparse part, lie.
struct GltfData::Elements {
  const std::uint8_t* begin = nullptr;
  std::size_t step = 0;
  ComponentType type{};
  bool normalized = false;

  [[nodiscard]] const std::uint8_t* at(std::size_t row, std::size_t column) const {
    return begin + row * step + column * type.bytes;
  }
  [[nodiscard]] float value(std::size_t row, std::size_t column) const {
    return component_value(at(row, column), type.code, normalized);
  }
  [[nodiscard]] std::uint32_t whole(std::size_t row) const {
    std::uint32_t value = 0;
    std::memcpy(&value, at(row, 0), type.bytes);  // little-endian
    return value;
  }
};

float component_value(const std::uint8_t* bytes, std::uint64_t code, bool normalized) {
  const float value = number_of(bytes, code);
  if (!normalized || code == kFloat) return value;
  return std::max(value / std::ranges::find(kComponents, code, &ComponentType::code)->most, -1.f);
}

std::string decode_percent_escapes(std::string_view text) {
  std::string decoded;
  for (std::size_t i = 0; i < text.size(); ++i) {
    unsigned code = 0;
    const std::string_view digits = text[i] == '%' ? text.substr(i + 1, 2) : std::string_view();
    const auto [rest, error] = std::from_chars(digits.data(), digits.data() + digits.size(), code, 16);
    const bool escaped = digits.size() == 2 && error == std::errc() && rest == digits.data() + 2;
    decoded += escaped ? static_cast<char>(code) : text[i];
    i += escaped ? 2 : 0;
  }
  return decoded;
}

std::optional<std::vector<std::uint8_t>> decode_data_uri(std::string_view uri) {
  constexpr std::string_view kBase64 = ";base64,";
  const std::size_t at = uri.starts_with("data:") ? uri.find(kBase64) : std::string_view::npos;
  if (at == std::string_view::npos) return std::nullopt;
  return decode_base64(uri.substr(at + kBase64.size()));
}

std::optional<std::size_t> index_of(const Json& object, std::string_view name, std::size_t size) {
  const auto index = object[name].whole();
  return index && *index < size ? index : std::nullopt;
}

std::size_t components_of(std::string_view type) {
  if (type == "SCALAR") return 1;
  const std::size_t side = type.empty() ? 0 : static_cast<std::size_t>(type.back() - '0');
  return type.starts_with("MAT") ? side * side : side;
}

void GltfData::fail(const std::string& cause) const { throw FileError(path_.string(), cause + " (damaged file)"); }

std::vector<std::uint8_t> GltfData::load(const Json& buffer, std::size_t index) const {
  const std::string_view uri = buffer["uri"].text();
  if (uri.empty()) {
    if (index > 0 || !document_.body) fail("buffer " + std::to_string(index) + " has no data");
    return read_gltf_body(document_, path_);
  }
  if (uri.starts_with("data:")) {
    auto bytes = decode_data_uri(uri);
    if (!bytes) fail("buffer " + std::to_string(index) + " is no base64 data");
    return *std::move(bytes);
  }
  const std::filesystem::path file = path_.parent_path() / decode_percent_escapes(uri);
  std::error_code ignored;
  if (!std::filesystem::is_regular_file(file, ignored)) {
    throw FileError(path_.string(), "lacks its buffer " + file.string() + ": no such file");
  }
  check_limit(file.string(), "bytes", size_of_file(file), options_.limits.file_bytes, "file_bytes");
  if (options_.trace) options_.trace->read.push_back(file);
  return read_file(file);
}

const std::vector<std::uint8_t>& GltfData::buffer(std::size_t index) {
  const auto [known, is_new] = buffers_.try_emplace(index);
  if (!is_new) return known->second;
  const Json& entry = document_.root["buffers"].items().at(index);
  known->second = load(entry, index);
  if (known->second.size() < entry["byteLength"].whole().value_or(0)) {
    fail("buffer " + std::to_string(index) + " has " + std::to_string(known->second.size()) +
         " bytes, fewer than the " + std::to_string(entry["byteLength"].whole().value_or(0)) + " that it should have");
  }
  return known->second;
}

/// The bytes of a buffer that `place` names.
std::span<const std::uint8_t> GltfData::part(const Json& place) {
  const auto& bytes = buffer(place["buffer"].whole().value_or(SIZE_MAX));
  const std::size_t offset = place["byteOffset"].whole().value_or(0);
  const std::size_t length = place["byteLength"].whole().value_or(0);
  return std::span(bytes).subspan(offset, length);
}

std::span<const std::uint8_t> GltfData::view(std::size_t index) {
  const Json& entry = document_.root["bufferViews"].items().at(index);
  const Json& compression = compression_of(entry);
  if (compression.is_null()) return part(entry);
  const auto [known, is_new] = decompressed_.try_emplace(index);
  if (is_new) {
    check_limit(path_.string(), "values of a bufferView", compression["count"].whole().value_or(0),
                vertex_limit(options_.limits), "triangles");
    known->second = decode_meshopt(compression, part(compression), path_);
  }
  return known->second;
}

GltfData::Elements GltfData::elements(const Json& place, const Json& type, std::size_t components) {
  const std::size_t index = place["bufferView"].whole().value_or(SIZE_MAX);
  const auto bytes = view(index);
  const auto* row = std::ranges::find(kComponents, type["componentType"].whole().value_or(0), &ComponentType::code);
  if (row == kComponents.end()) fail("an accessor has elements of an unknown type");
  Elements elements{.type = *row, .normalized = type["normalized"].is_true()};
  const Json& entry = document_.root["bufferViews"].items().at(index);
  elements.step = std::max<std::size_t>(entry["byteStride"].whole().value_or(0), components * row->bytes);
  elements.begin = bytes.data() + place["byteOffset"].whole().value_or(0);
  return elements;
}

std::size_t GltfData::checked_count(const Json& accessor) const {
  const std::size_t count = accessor["count"].whole().value_or(0);
  check_limit(path_.string(), "values of an accessor", count, vertex_limit(options_.limits), "triangles");
  return count;
}

GltfValues GltfData::read(std::size_t index) {
  const Json& accessor = document_.root["accessors"].items().at(index);
  GltfValues values{checked_count(accessor), components_of(accessor["type"].text()), {}};
  const bool is_zero = accessor["bufferView"].is_null();
  if (is_zero && (accessor["sparse"].is_null() || values.count > kMostZeroRows)) {
    fail("accessor " + std::to_string(index) + " has no data");
  }
  values.numbers.resize(values.count * values.components);
  if (!is_zero && values.count > 0) {
    const Elements elements = this->elements(accessor, accessor, values.components);
    for (std::size_t i = 0; i < values.count; ++i) {
      for (std::size_t c = 0; c < values.components; ++c) values.row(i)[c] = elements.value(i, c);
    }
  }
  if (!accessor["sparse"].is_null()) read_sparse(accessor, values);
  return values;
}

std::vector<std::uint32_t> GltfData::read_indices(std::size_t index) {
  const Json& accessor = document_.root["accessors"].items().at(index);
  const std::uint64_t code = accessor["componentType"].whole().value_or(0);
  if (accessor["type"].text() != "SCALAR" || (code != 5121 && code != 5123 && code != 5125)) {
    fail("accessor " + std::to_string(index) + " is no list of indices");
  }
  if (accessor["bufferView"].is_null() || !accessor["sparse"].is_null()) {
    fail("accessor " + std::to_string(index) + " has no indices of its own");
  }
  std::vector<std::uint32_t> indices(checked_count(accessor));
  if (indices.empty()) return indices;
  const Elements elements = this->elements(accessor, accessor, 1);
  for (std::size_t i = 0; i < indices.size(); ++i) indices[i] = elements.whole(i);
  return indices;
}

void GltfData::read_sparse(const Json& accessor, GltfValues& values) {
  const Json& sparse = accessor["sparse"];
  const std::size_t count = sparse["count"].whole().value_or(0);
  if (count == 0) return;
  const Elements indices = elements(sparse["indices"], sparse["indices"], 1);
  const Elements changed = elements(sparse["values"], accessor, values.components);
  for (std::size_t i = 0; i < count; ++i) {
    const std::uint32_t row = indices.whole(i);
    if (row >= values.count) {
      fail("a sparse accessor changes entry " + std::to_string(row) + " of " + std::to_string(values.count));
    }
    for (std::size_t c = 0; c < values.components; ++c) values.row(row)[c] = changed.value(i, c);
  }
}

}  // namespace wiw::scene
