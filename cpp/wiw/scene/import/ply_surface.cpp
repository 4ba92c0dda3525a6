// SPDX-License-Identifier: Apache-2.0
#include "wiw/scene/import/ply_surface.hpp"

#include <algorithm>
#include <array>
#include <bit>
#include <cmath>
#include <cstring>
#include <optional>
#include <string_view>

#include "wiw/core/error.hpp"
#include "wiw/scene/import/file.hpp"
#include "wiw/scene/import/ply_header.hpp"
#include "wiw/scene/import/polygon.hpp"

namespace wiw::scene {
namespace {

template <class T>
T swapped(T value) {
  auto bytes = std::bit_cast<std::array<std::uint8_t, sizeof(T)>>(value);
  std::ranges::reverse(bytes);
  return std::bit_cast<T>(bytes);
}

/// Walks over the body of a file that `check_ply` has found complete.
class PlyBody {
 public:
  PlyBody(std::string_view file, std::size_t at, bool big_endian) : file_(file), at_(at), swap_(big_endian) {}

  double number(std::string_view type) {
    if (type == "char" || type == "int8") return take<std::int8_t>();
    if (type == "uchar" || type == "uint8") return take<std::uint8_t>();
    if (type == "short" || type == "int16") return take<std::int16_t>();
    if (type == "ushort" || type == "uint16") return take<std::uint16_t>();
    if (type == "int" || type == "int32") return take<std::int32_t>();
    if (type == "uint" || type == "uint32") return take<std::uint32_t>();
    if (type == "double" || type == "float64") return take<double>();
    return take<float>();
  }
  std::size_t length(std::size_t bytes) {
    if (bytes == 1) return take<std::uint8_t>();
    if (bytes == 8) return take<std::uint64_t>();
    return bytes == 2 ? take<std::uint16_t>() : take<std::uint32_t>();
  }
  void skip(const PlyProperty& property) {
    at_ += property.bytes * (property.count_bytes > 0 ? length(property.count_bytes) : 1);
  }

 private:
  template <class T>
  T take() {
    T value;
    std::memcpy(&value, file_.data() + at_, sizeof(T));
    at_ += sizeof(T);
    return swap_ ? swapped(value) : value;
  }

  std::string_view file_;
  std::size_t at_;
  bool swap_;
};

constexpr std::array<std::string_view, 3> kAxes{"x", "y", "z"};
constexpr std::array<std::string_view, 3> kChannels{"red", "green", "blue"};

/// Index of a name, or nothing.
template <std::size_t N>
std::optional<std::size_t> index_of(const std::array<std::string_view, N>& names, const std::string& name) {
  const auto* found = std::ranges::find(names, name);
  if (found == names.end()) return std::nullopt;
  return static_cast<std::size_t>(found - names.begin());
}

bool has(const PlyElement& element, std::string_view name, bool is_list = false) {
  return std::ranges::any_of(element.properties, [&](const PlyProperty& property) {
    return property.name == name && (property.count_bytes > 0) == is_list;
  });
}

void check_number(double number, const std::string& path, const char* row, std::size_t index,
                  const PlyProperty& property) {
  if (!std::isnan(number)) return;
  throw FileError(path, std::string(row) + " " + std::to_string(index) + " has a '" + property.name +
                            "' that is not a number (damaged file)");
}

void read_vertices(const PlyElement& element, PlyBody& body, const std::string& path, PlySurface& surface) {
  for (const std::string_view axis : kAxes) {
    if (!has(element, axis)) throw FileError(path, "has vertices without " + std::string(axis));
  }
  const bool colored = std::ranges::all_of(kChannels, [&](std::string_view channel) { return has(element, channel); });
  surface.vertices.resize(element.count);
  if (colored) surface.colors.assign(element.count, {0, 0, 0, 255});
  for (std::size_t i = 0; i < element.count; ++i) {
    for (const PlyProperty& property : element.properties) {
      const auto axis = index_of(kAxes, property.name);
      const auto channel = index_of(kChannels, property.name);
      if (property.count_bytes > 0 || (!axis && !(channel && colored))) {
        body.skip(property);
        continue;
      }
      const double number = body.number(property.type);
      if (axis) surface.vertices[i][static_cast<int>(*axis)] = static_cast<float>(number);
      if (channel) {
        check_number(number, path, "vertex", i, property);
        surface.colors[i][static_cast<int>(*channel)] = static_cast<std::uint8_t>(std::clamp(number, 0., 255.));
      }
    }
    if (!surface.vertices[i].allFinite()) {
      throw FileError(path, "vertex " + std::to_string(i) + " is not finite (damaged file)");
    }
  }
}

bool is_corner_list(const PlyProperty& property) {
  return property.count_bytes > 0 && (property.name == "vertex_indices" || property.name == "vertex_index");
}

void read_corners(const PlyProperty& property, PlyBody& body, const std::string& where, std::size_t vertices,
                  std::vector<unsigned>& corners) {
  corners.resize(body.length(property.count_bytes));
  for (unsigned& corner : corners) {
    const double number = body.number(property.type);
    if (!(number >= 0 && number < static_cast<double>(vertices))) {
      throw FileError(where, "names a vertex that is not there (damaged file)");
    }
    corner = static_cast<unsigned>(number);
  }
}

void read_faces(const PlyElement& element, const std::string& label, PlyBody& body, const std::string& path,
                const ImportLimits& limits, PlySurface& surface) {
  if (!has(element, label)) {
    throw FileError(path, "has faces without the property '" + label + "', which says what object each belongs to");
  }
  if (std::ranges::none_of(element.properties, is_corner_list)) throw FileError(path, "has faces without vertices");
  std::vector<unsigned> corners;
  for (std::size_t i = 0; i < element.count; ++i) {
    std::int64_t value = 0;
    for (const PlyProperty& property : element.properties) {
      if (is_corner_list(property)) {
        read_corners(property, body, path + ": face " + std::to_string(i), surface.vertices.size(), corners);
      } else if (property.count_bytes == 0 && property.name == label) {
        const double number = body.number(property.type);
        check_number(number, path, "face", i, property);
        value = static_cast<std::int64_t>(std::clamp(number, -1e9, 1e10));
      } else {
        body.skip(property);
      }
    }
    triangulate(corners, surface.vertices, surface.triangles);
    surface.labels.resize(surface.triangles.size(), value);
    check_limit(path, "triangles", surface.triangles.size(), limits.triangles, "triangles");
  }
}

PlySurface read_surface(const std::filesystem::path& path, const std::string& label, const ImportLimits& limits) {
  check_limit(path.string(), "bytes", size_of_file(path), limits.file_bytes, "file_bytes");
  check_ply(path);
  const auto bytes = read_file(path);
  const std::string_view file(reinterpret_cast<const char*>(bytes.data()), bytes.size());
  const PlyHeader header = read_ply_header(file, path.string());
  if (header.format == "ascii") throw FileError(path.string(), "is a PLY file of text; expected a binary one");
  PlyBody body(file, header.bytes, header.format == "binary_big_endian");
  PlySurface surface;
  for (const PlyElement& element : header.elements) {
    if (element.name == "vertex") {
      read_vertices(element, body, path.string(), surface);
    } else if (element.name == "face") {
      read_faces(element, label, body, path.string(), limits, surface);
    } else {
      for (std::size_t i = 0; i < element.count; ++i) {
        for (const PlyProperty& property : element.properties) body.skip(property);
      }
    }
  }
  if (surface.triangles.empty()) throw FileError(path.string(), "holds no triangles");
  return surface;
}

}  // namespace

PlySurface read_ply_surface(const std::filesystem::path& path, const std::string& label, const ImportLimits& limits) {
  return read_as_file(path, [&] { return read_surface(path, label, limits); });
}

}  // namespace wiw::scene
