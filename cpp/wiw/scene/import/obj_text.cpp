// SPDX-License-Identifier: Apache-2.0
#include "wiw/scene/import/obj_text.hpp"

#include <algorithm>
#include <array>
#include <string>
#include <string_view>

#include "wiw/core/error.hpp"

namespace wiw::scene {
namespace fs = std::filesystem;
namespace {

std::string_view as_text(std::span<const std::uint8_t> bytes) {
  return {reinterpret_cast<const char*>(bytes.data()), bytes.size()};
}

/// Calls `visit` with the number of each line, from 1, and the line, as long as it returns true.
template <class Visit>
void visit_lines(std::span<const std::uint8_t> bytes, const Visit& visit) {
  std::string_view text = as_text(bytes);
  for (std::size_t number = 1; !text.empty(); ++number) {
    const std::size_t end = std::min(text.find('\n'), text.size());
    if (!visit(number, text.substr(0, end))) return;
    text.remove_prefix(std::min(end + 1, text.size()));
  }
}

/// Lines that assimp takes as a property of the material before them without a look whether there is one. It goes by
/// the first letters.
bool needs_material(std::string_view line) {
  constexpr std::array<std::string_view, 7> kBeginnings{"m", "b", "r", "a", "disp", "no", "No"};
  return std::ranges::any_of(kBeginnings, [&](std::string_view beginning) { return line.starts_with(beginning); });
}

}  // namespace

void unify_line_ends(const fs::path& path, std::vector<std::uint8_t>& bytes) {
  const std::string_view text = as_text(bytes);
  if (text.starts_with("\xff\xfe") || text.starts_with("\xfe\xff")) {
    throw FileError(path.string(), "is text in UTF-16; expected UTF-8: save it as such");
  }
  std::size_t kept = 0;
  for (std::size_t i = text.starts_with("\xef\xbb\xbf") ? 3 : 0; i < bytes.size(); ++i) {
    if (bytes[i] == '\r' && i + 1 < bytes.size() && bytes[i + 1] == '\n') continue;
    const bool ends = bytes[i] == '\r' || bytes[i] == '\f' || bytes[i] == '\0';
    bytes[kept++] = ends ? '\n' : bytes[i];
  }
  bytes.resize(kept);
}

void join_continued_lines(std::vector<std::uint8_t>& bytes) {
  for (std::size_t i = 0; i < bytes.size(); ++i) {
    if (bytes[i] != '\\' || (i + 1 < bytes.size() && bytes[i + 1] != '\n')) continue;
    bytes[i] = ' ';
    if (i + 1 < bytes.size()) bytes[i + 1] = ' ';
  }
}

void check_library_names(const fs::path& path, std::span<const std::uint8_t> bytes) {
  visit_lines(bytes, [&](std::size_t number, std::string_view line) {
    if (line.starts_with("mtllib") && line.find("://") != std::string_view::npos) {
      throw FileError(path.string(), "line " + std::to_string(number) + " has '" + std::string(line.substr(0, 80)) +
                                         "'; expected the name of a file beside it, not an address");
    }
    return true;
  });
}

void check_obj_materials(const fs::path& path, std::span<const std::uint8_t> bytes) {
  visit_lines(bytes, [&](std::size_t number, std::string_view line) {
    // assimp passes over blanks at the beginning of every line but the first
    if (number > 1) line.remove_prefix(std::min(line.find_first_not_of(" \t"), line.size()));
    if (line.starts_with("ne") || line.starts_with("Ne")) return false;
    if (needs_material(line)) {
      throw FileError(path.string(), "line " + std::to_string(number) + " has '" +
                                         std::string(line.substr(0, line.find_first_of(" \t"))) +
                                         "' before any 'newmtl'; expected it behind the name of its material "
                                         "(damaged file)");
    }
    return true;
  });
}

}  // namespace wiw::scene
