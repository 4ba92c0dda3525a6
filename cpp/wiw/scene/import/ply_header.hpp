// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstddef>
#include <filesystem>
#include <string>
#include <string_view>
#include <vector>

namespace wiw::scene {

struct PlyProperty {
  std::string name;
  std::string type;             // of a value, or of a list's entries: "float", "uint8", ...
  std::size_t bytes = 0;        // of such a value
  std::size_t count_bytes = 0;  // of a list's length; 0: no list
};

struct PlyElement {
  std::string name;
  std::size_t count = 0;
  std::vector<PlyProperty> properties;
};

struct PlyHeader {
  std::string format;
  std::vector<PlyElement> elements;
  std::size_t bytes = 0;  // up to and with `end_header`
};

/// The header of a PLY file; `path` is named in errors. Throws FileError for lines and types that no PLY has.
PlyHeader read_ply_header(std::string_view file, const std::string& path);

/// Reads the header of a PLY file and walks its binary body, because assimp's reader neither checks the one nor stops
/// at the end of the other. Throws FileError naming what is wrong.
void check_ply(const std::filesystem::path& path);

}  // namespace wiw::scene
