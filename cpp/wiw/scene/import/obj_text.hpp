// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstdint>
#include <filesystem>
#include <span>
#include <vector>

namespace wiw::scene {

/// Makes every line end of an OBJ file, or of its materials, a line feed, and drops the mark of UTF-8 at the beginning:
/// assimp ends lines at form feeds and zeros too, and does not know the mark. Throws FileError for UTF-16.
void unify_line_ends(const std::filesystem::path& path, std::vector<std::uint8_t>& bytes);

/// Joins lines that a backslash at their end continues. Assimp looks for the next line beyond the end of the file.
void join_continued_lines(std::vector<std::uint8_t>& bytes);

/// Checks that an OBJ file names no materials by an address, such as "file://m.mtl": assimp passes the end of a name
/// that ends soon after it. Throws FileError naming the line.
void check_library_names(const std::filesystem::path& path, std::span<const std::uint8_t> bytes);

/// Checks the materials of an OBJ file, with unified line ends: assimp follows a texture that belongs to no material
/// into nowhere. Throws FileError naming the file and its line.
void check_obj_materials(const std::filesystem::path& path, std::span<const std::uint8_t> bytes);

}  // namespace wiw::scene
