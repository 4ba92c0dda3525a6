// SPDX-License-Identifier: Apache-2.0
#include "wiw/scene/import/gltf_data.hpp"

#include <algorithm>
#include <array>
#include <charconv>
#include <cstring>

#include "wiw/core/error.hpp"
#include "wiw/scene/import/file.hpp"
#include "wiw/scene/import/gltf_nodes.hpp"

namespace wiw::scene {
namespace {

struct ComponentType {
  std::uint64_t code;
  std::size_t bytes;
  float most;  // of the integer, which is 1 where it is normalised
};
constexpr std::array<ComponentType, 6> kComponents{
    {{5120, 1, 127.f}, {5121, 1, 255.f}, {5122, 2, 32767.f}, {5123, 2, 65535.f}, {5125, 4, 1.f}, {5126, 4, 1.f}}};

template <class T>
float number_at(const std::uint8_t* bytes) {
  T value;
  std::memcpy(&value, bytes, sizeof(value));
  return static_cast<float>(value);
}

float component_at(const std::uint8_t* bytes, std::uint64_t code) {
  switch (code) {
    case 5120: return number_at<std::int8_t>(bytes);
    case 5121: return number_at<std::uint8_t>(bytes);
    case 5122: return number_at<std::int16_t>(bytes);
    case 5123: return number_at<std::uint16_t>(bytes);
    case 5125: return number_at<std::uint32_t>(bytes);
    default: return number_at<float>(bytes);
  }
}

std::size_t components_of(std::string_view type) {
  if (type == "SCALAR") return 1;
  const std::size_t side = type.empty() ? 0 : static_cast<std::size_t>(type.back() - '0');
  return type.starts_with("MAT") ? side * side : side;
}

/// A base64 text; what is none of its letters ends it.
std::vector<std::uint8_t> decode_base64(std::string_view text) {
  constexpr std::string_view kLetters = "ABCDEFGHIJKLMNOPQRSTUVWXYZabcdefghijklmnopqrstuvwxyz0123456789+/";
  std::vector<std::uint8_t> bytes;
  std::uint32_t bits = 0;
  unsigned count = 0;
  for (const char letter : text) {
    const std::size_t value = kLetters.find(letter);
    if (value == std::string_view::npos) break;
    bits = bits << 6U | static_cast<std::uint32_t>(value);
    count += 6;
    if (count < 8) continue;
    count -= 8;
    bytes.push_back(static_cast<std::uint8_t>(bits >> count));
  }
  return bytes;
}

}  // namespace

/// Where the rows of an accessor, or the entries of its sparse part, lie.
struct GltfData::Elements {
  const std::uint8_t* begin = nullptr;
  std::size_t step = 0;
  ComponentType type{};
  std::size_t components = 0;
  bool normalized = false;

  [[nodiscard]] float at(std::size_t row, std::size_t column) const {
    const float value = component_at(begin + row * step + column * type.bytes, type.code);
    return normalized ? std::max(value / type.most, -1.f) : value;
  }
};

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

void GltfData::fail(const std::string& cause) const { throw FileError(path_.string(), cause + " (damaged file)"); }

std::vector<std::uint8_t> GltfData::body() const {
  auto bytes = read_file(path_, document_.body_offset + document_.body.value_or(0));
  bytes.erase(bytes.begin(), bytes.begin() + static_cast<std::ptrdiff_t>(document_.body_offset));
  return bytes;
}

std::vector<std::uint8_t> GltfData::load(const Json& buffer, std::size_t index) const {
  const std::string_view uri = buffer["uri"].text();
  if (uri.empty()) {
    if (index > 0 || !document_.body) fail("buffer " + std::to_string(index) + " has no data");
    return body();
  }
  if (uri.starts_with("data:")) {
    const std::size_t comma = uri.find(";base64,");
    if (comma == std::string_view::npos) fail("buffer " + std::to_string(index) + " is no base64 data");
    return decode_base64(uri.substr(comma + 8));
  }
  const std::filesystem::path file = path_.parent_path() / decode_percent_escapes(uri);
  check_limit(file.string(), "bytes", size_of_file(file), options_.limits.file_bytes, "file_bytes");
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

GltfData::Elements GltfData::elements(const Json& place, const Json& type, std::size_t components) {
  const Json& view = document_.root["bufferViews"].items().at(place["bufferView"].whole().value_or(SIZE_MAX));
  const auto& bytes = buffer(view["buffer"].whole().value_or(0));
  const auto* row = std::ranges::find(kComponents, type["componentType"].whole().value_or(0), &ComponentType::code);
  if (row == kComponents.end()) fail("an accessor has elements of an unknown type");
  Elements elements{.type = *row, .components = components, .normalized = type["normalized"].is_true()};
  const std::size_t dense = components * row->bytes;
  elements.step = std::max<std::size_t>(view["byteStride"].whole().value_or(0), dense);
  elements.begin = bytes.data() + view["byteOffset"].whole().value_or(0) + place["byteOffset"].whole().value_or(0);
  return elements;
}

GltfValues GltfData::read(std::size_t index) {
  const Json& accessor = document_.root["accessors"].items().at(index);
  GltfValues values{accessor["count"].whole().value_or(0), components_of(accessor["type"].text()), {}};
  check_limit(path_.string(), "values of an accessor", values.count, vertex_limit(options_.limits), "triangles");
  values.numbers.resize(values.count * values.components);
  if (!accessor["bufferView"].is_null() && values.count > 0) {
    const Elements elements = this->elements(accessor, accessor, values.components);
    for (std::size_t i = 0; i < values.count; ++i) {
      for (std::size_t c = 0; c < values.components; ++c) values.row(i)[c] = elements.at(i, c);
    }
  }
  if (!accessor["sparse"].is_null()) read_sparse(accessor, values);
  return values;
}

void GltfData::read_sparse(const Json& accessor, GltfValues& values) {
  const Json& sparse = accessor["sparse"];
  const std::size_t count = sparse["count"].whole().value_or(0);
  if (count == 0) return;
  const Elements indices = elements(sparse["indices"], sparse["indices"], 1);
  const Elements changed = elements(sparse["values"], accessor, values.components);
  for (std::size_t i = 0; i < count; ++i) {
    std::uint32_t row = 0;
    std::memcpy(&row, indices.begin + i * indices.step, indices.type.bytes);  // little-endian
    if (row >= values.count) {
      fail("a sparse accessor changes entry " + std::to_string(row) + " of " + std::to_string(values.count));
    }
    for (std::size_t c = 0; c < values.components; ++c) values.row(row)[c] = changed.at(i, c);
  }
}

}  // namespace wiw::scene
