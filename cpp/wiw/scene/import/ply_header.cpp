// SPDX-License-Identifier: Apache-2.0
#include "wiw/scene/import/ply_header.hpp"

#include <algorithm>
#include <array>
#include <bit>
#include <charconv>
#include <cstdint>
#include <cstring>
#include <optional>
#include <set>
#include <sstream>
#include <string>
#include <string_view>
#include <vector>

#include "wiw/core/error.hpp"
#include "wiw/scene/import/file.hpp"

namespace wiw::scene {
namespace {

constexpr std::string_view kLineEnds("\0\f\r", 3);  // of assimp's, beside the newline
constexpr std::size_t kMostEntries = 1 << 16;       // of one face; more is damage

std::size_t bytes_of(const std::string& type) {
  struct TypeSize {
    std::string_view name;
    std::size_t bytes;
  };
  constexpr std::array<TypeSize, 16> kTypes{{{"char", 1},
                                             {"uchar", 1},
                                             {"int8", 1},
                                             {"uint8", 1},
                                             {"short", 2},
                                             {"ushort", 2},
                                             {"int16", 2},
                                             {"uint16", 2},
                                             {"int", 4},
                                             {"uint", 4},
                                             {"int32", 4},
                                             {"uint32", 4},
                                             {"float", 4},
                                             {"float32", 4},
                                             {"double", 8},
                                             {"float64", 8}}};
  const auto* row = std::ranges::find(kTypes, type, &TypeSize::name);
  return row == kTypes.end() ? 0 : row->bytes;
}

bool is_whole(std::string_view type) { return !type.starts_with("float") && !type.starts_with("double"); }

/// assimp gives each vertex and face its place by the element's count, so it must meet each element once, and faces
/// after the vertices that they name.
void check_elements(const PlyHeader& header, const std::string& path) {
  std::set<std::string_view> names;
  for (const PlyElement& element : header.elements) {
    if (!names.insert(element.name).second) {
      throw FileError(path, "declares the element '" + element.name + "' twice (damaged file)");
    }
    if (element.name == "face" && !names.contains("vertex")) {
      throw FileError(path, "declares no element 'vertex' before its faces; export it with the vertices first");
    }
    if (element.properties.empty() && element.count > 0) {
      throw FileError(path, "declares no property of the element '" + element.name + "' (damaged file)");
    }
  }
  for (const char* needed : {"vertex", "face"}) {
    if (!names.contains(needed)) throw FileError(path, std::string("declares no element '") + needed + "'");
  }
}

std::size_t list_length(std::string_view file, std::size_t at, std::size_t bytes, bool big_endian) {
  std::uint64_t length = 0;
  for (std::size_t i = 0; i < bytes; ++i) {
    const std::size_t from = big_endian ? bytes - 1 - i : i;
    length |= std::uint64_t{static_cast<unsigned char>(file[at + from])} << (8 * i);
  }
  return length;
}

/// Offset behind one row of `element`; npos if the file ends before.
std::size_t row_end(const PlyElement& element, std::string_view file, std::size_t at, bool big_endian) {
  for (const PlyProperty& property : element.properties) {
    std::size_t entries = 1;
    if (property.count_bytes > 0) {
      if (at + property.count_bytes > file.size()) return std::string_view::npos;
      entries = list_length(file, at, property.count_bytes, big_endian);
      if (entries > kMostEntries) return std::string_view::npos;
      at += property.count_bytes;
    }
    at += entries * property.bytes;
    if (at > file.size()) return std::string_view::npos;
  }
  return at;
}

void check_binary(const PlyHeader& header, std::string_view file, const std::string& path) {
  std::size_t at = header.bytes;
  for (const PlyElement& element : header.elements) {
    for (std::size_t row = 0; row < element.count; ++row) {
      at = row_end(element, file, at, header.format == "binary_big_endian");
      if (at == std::string_view::npos) {
        throw FileError(path, "ends at " + element.name + " " + std::to_string(row) + " of " +
                                  std::to_string(element.count) + " (truncated or damaged file)");
      }
    }
  }
}

std::string_view take_token(std::string_view& line) {
  constexpr std::string_view kSpace = " \t\r";
  line.remove_prefix(std::min(line.find_first_not_of(kSpace), line.size()));
  const std::string_view token = line.substr(0, line.find_first_of(kSpace));
  line.remove_prefix(token.size());
  return token;
}

/// A whole number of zero or more that is all of the token.
std::optional<std::size_t> count_of(std::string_view token) {
  std::size_t count = 0;
  const auto [rest, error] = std::from_chars(token.data(), token.data() + token.size(), count);
  if (error != std::errc() || rest != token.data() + token.size()) return std::nullopt;
  return count;
}

/// Whether a row has all numbers, and the entries that its lists announce: assimp fills in what is missing from another
/// row, and takes memory for as many entries as are announced.
bool has_entries(const PlyElement& element, std::string_view line) {
  for (const PlyProperty& property : element.properties) {
    const std::string_view token = take_token(line);
    if (token.empty()) return false;
    if (property.count_bytes == 0) continue;
    const auto entries = count_of(token);
    if (!entries) return false;
    for (std::size_t i = 0; i < *entries; ++i) {
      if (take_token(line).empty()) return false;
    }
  }
  return true;
}

/// The next line that is neither empty nor a comment.
std::string_view take_row(std::string_view& body) {
  std::string_view line;
  while (!body.empty() && (line.empty() || line.starts_with("comment"))) {
    line = body.substr(0, body.find('\n'));
    body.remove_prefix(std::min(line.size() + 1, body.size()));
    line.remove_suffix(line.ends_with('\r') ? 1 : 0);
  }
  return line;
}

/// Whether lines end as they do here for assimp, too, which also ends them at NUL, form feed and lone carriage returns.
bool has_plain_lines(std::string_view body) {
  for (std::size_t at = body.find_first_of(kLineEnds); at < body.size(); at = body.find_first_of(kLineEnds, at + 1)) {
    if (body[at] != '\r' || !body.substr(at + 1).starts_with('\n')) return false;
  }
  return true;
}

void check_ascii(const PlyHeader& header, std::string_view file, const std::string& path) {
  auto body = file.substr(header.bytes);
  auto lines = static_cast<std::size_t>(std::ranges::count(body, '\n')) + (body.empty() || body.back() == '\n' ? 0 : 1);
  for (const PlyElement& element : header.elements) {
    if (element.count > lines) {
      throw FileError(path, "should have " + std::to_string(element.count) + " rows of the element '" + element.name +
                                "' but has " + std::to_string(lines) + " left for them (truncated file)");
    }
    lines -= element.count;
  }
  if (!has_plain_lines(body)) throw FileError(path, "has bytes that no text has (damaged file)");
  for (const PlyElement& element : header.elements) {
    for (std::size_t row = 0; row < element.count; ++row) {
      if (has_entries(element, take_row(body))) continue;
      throw FileError(path,
                      element.name + " " + std::to_string(row) + " has fewer entries than it says (damaged file)");
    }
  }
}

}  // namespace

PlyHeader read_ply_header(std::string_view file, const std::string& path) {
  PlyHeader header;
  std::size_t at = 0;
  while (at < file.size()) {
    const std::size_t end = std::min(file.find('\n', at), file.size());
    std::istringstream line{std::string(file.substr(at, end - at))};
    at = end + 1;
    std::string word;
    line >> word;
    constexpr std::array<std::string_view, 7> kWords{"ply",     "format",   "comment",   "obj_info",
                                                     "element", "property", "end_header"};
    if (!word.empty() && std::ranges::find(kWords, word) == kWords.end()) {
      throw FileError(path, "has a header line that begins with '" + word + "' (damaged file)");
    }
    if (word == "end_header") {
      header.bytes = at;
      return header;
    }
    if (word == "format") line >> header.format;
    if (word == "element") {
      PlyElement element;
      std::string count;
      line >> element.name >> count;
      const auto rows = count_of(count);
      if (!rows) throw FileError(path, "has an <element> line without name and count (damaged file)");
      element.count = *rows;
      header.elements.push_back(std::move(element));
    }
    if (word == "property") {
      std::string type;
      std::string count_type;
      line >> type;
      PlyProperty property;
      if (type == "list") {
        line >> count_type >> type;
        property.count_bytes = is_whole(count_type) ? bytes_of(count_type) : 0;
      }
      line >> property.name;
      property.type = type;
      property.bytes = bytes_of(type);
      if (property.bytes == 0 || (!count_type.empty() && property.count_bytes == 0) || header.elements.empty()) {
        throw FileError(path, "has a property of unknown type '" + type + "' (damaged file)");
      }
      header.elements.back().properties.push_back(property);
    }
  }
  throw FileError(path, "ends within its header (truncated file)");
}

void check_ply(const std::filesystem::path& path) {
  const auto bytes = read_file(path);
  const std::string_view file(reinterpret_cast<const char*>(bytes.data()), bytes.size());
  const PlyHeader header = read_ply_header(file, path.string());
  check_elements(header, path.string());
  if (header.format == "ascii") {
    check_ascii(header, file, path.string());
  } else if (header.format == "binary_little_endian" || header.format == "binary_big_endian") {
    check_binary(header, file, path.string());
  } else {
    throw FileError(path.string(),
                    "has format '" + header.format + "'; expected ascii, binary_little_endian or binary_big_endian");
  }
}

}  // namespace wiw::scene
