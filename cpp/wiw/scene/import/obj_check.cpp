// SPDX-License-Identifier: Apache-2.0
#include "wiw/scene/import/obj_check.hpp"

#include <algorithm>
#include <array>
#include <fstream>
#include <string>
#include <string_view>

#include "wiw/core/error.hpp"
#include "wiw/scene/import/file.hpp"

namespace wiw::scene {
namespace fs = std::filesystem;
namespace {

/// Lines that assimp takes as a property of the material before them without a look whether there is one. It goes by
/// the first letters and leaves indented lines out.
bool needs_material(std::string_view line) {
  constexpr std::array<std::string_view, 7> kBeginnings{"m", "b", "r", "a", "disp", "no", "No"};
  return std::ranges::any_of(kBeginnings, [&](std::string_view beginning) { return line.starts_with(beginning); });
}

void check_materials(const fs::path& path) {
  const auto bytes = read_file(path);
  std::string_view text(reinterpret_cast<const char*>(bytes.data()), bytes.size());
  for (std::size_t number = 1; !text.empty(); ++number) {
    const std::size_t end = std::min(text.find_first_of("\r\n"), text.size());
    const std::string_view line = text.substr(0, end);
    if (line.starts_with("ne") || line.starts_with("Ne")) return;
    if (needs_material(line)) {
      throw FileError(path.string(), "line " + std::to_string(number) + " has '" +
                                         std::string(line.substr(0, line.find_first_of(" \t"))) +
                                         "' before any 'newmtl'; expected it behind the name of its material "
                                         "(damaged file)");
    }
    text.remove_prefix(std::min(end + 1, text.size()));
  }
}

/// The file that a `mtllib` line names; where there is none, assimp looks for one that is called like the OBJ.
fs::path material_file(const fs::path& path, std::string name) {
  name.erase(0, std::min(name.find_first_not_of(" \t"), name.size()));
  name.erase(name.find_last_not_of(" \t\r") + 1);
  std::error_code ignored;
  const fs::path named = path.parent_path() / name;
  return fs::is_regular_file(named, ignored) ? named : fs::path(path).replace_extension(".mtl");
}

}  // namespace

void check_obj(const fs::path& path) {
  constexpr std::string_view kKeyword = "mtllib";
  std::ifstream stream(path, std::ios::binary);
  for (std::string line; std::getline(stream, line);) {
    if (!line.starts_with(kKeyword)) continue;
    const fs::path materials = material_file(path, line.substr(kKeyword.size()));
    std::error_code ignored;
    if (fs::is_regular_file(materials, ignored)) check_materials(materials);
  }
}

}  // namespace wiw::scene
