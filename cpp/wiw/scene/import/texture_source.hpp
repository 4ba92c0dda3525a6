// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <filesystem>
#include <map>
#include <string>
#include <vector>

#include "wiw/scene/import.hpp"

struct aiScene;

namespace wiw::scene {

/// Finds and decodes the textures a mesh file refers to. A reference is tried as
///  1. an image embedded in the file;
///  2. a path relative to the file (backslashes, `file://` and %20 understood);
///  3. its base name in the file's folder, `textures`, `../textures`, `materials/textures`, `../materials/textures`
///     and the folders of ImportOptions::texture_folders.
class TextureSource {
 public:
  TextureSource(const aiScene& file, std::filesystem::path path, const ImportOptions& options);

  /// Decodes all references in parallel into scene.textures, once their headers have told that they keep the limits. A
  /// reference without a usable image adds one warning. Throws FileError above limits.texture_bytes.
  void load(const std::vector<std::string>& references, Scene& scene);

  /// Index into Scene::textures; kNone if the reference could not be loaded.
  [[nodiscard]] std::int32_t find(const std::string& reference) const;

 private:
  struct Found;
  [[nodiscard]] Found look_for(const std::string& reference) const;
  void find_file(const std::string& reference, Found& found) const;
  static Texture decode(const std::string& reference, const Found& found);
  void check_bytes(const std::vector<Found>& found) const;
  /// Names that are not UTF-8 are tried as they are and as Latin-1.
  [[nodiscard]] std::vector<std::filesystem::path> candidates(const std::string& reference) const;
  void add_candidates(const std::filesystem::path& wanted, std::vector<std::filesystem::path>& paths) const;

  const aiScene& file_;
  std::filesystem::path path_;
  const ImportOptions& options_;
  std::map<std::string, std::int32_t> indices_;
};

}  // namespace wiw::scene
