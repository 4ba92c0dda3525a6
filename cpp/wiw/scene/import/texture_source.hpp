// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <filesystem>
#include <map>
#include <optional>
#include <span>
#include <string>
#include <vector>

#include "wiw/scene/import.hpp"

namespace wiw::scene {

/// Stands in for a texture that is missing, and for a colour that nobody names.
constexpr float kNeutralGrey = 0.7f;

/// An image that a mesh file refers to.
struct ImageReference {
  std::string name;                                       // unique in the file; where to look, if it is not embedded
  std::optional<std::span<const std::uint8_t>> embedded;  // the image, where the mesh file has it itself
};

/// Finds and decodes the images that a mesh file refers to. One that is not embedded is tried as
///  1. a path relative to the file (backslashes, `file://` and %20 understood);
///  2. its base name in the file's folder, `textures`, `../textures`, `materials/textures`, `../materials/textures`
///     and the folders of ImportOptions::texture_folders.
class TextureSource {
 public:
  TextureSource(std::filesystem::path path, const ImportOptions& options);

  /// Decodes all images in parallel, once their headers have told that they keep the limits. One that cannot be used
  /// adds a warning to the scene. Throws FileError above limits.texture_bytes.
  void load(const std::vector<ImageReference>& images, Scene& scene);

  /// Index into Scene::textures, added when first asked for; kNone if the image could not be loaded.
  std::int32_t find(const std::string& image, const Sampling& sampling, Scene& scene);

 private:
  struct Found;
  [[nodiscard]] Found look_for(const ImageReference& image) const;
  void find_file(const std::string& name, Found& found) const;
  [[nodiscard]] Texture decode(const Found& found) const;
  void check_bytes(const std::vector<Found>& found) const;
  void warn(const std::vector<Found>& found, Scene& scene) const;
  /// Names that are not UTF-8 are tried as they are and as Latin-1.
  [[nodiscard]] std::vector<std::filesystem::path> candidates(const std::string& name) const;
  void add_candidates(const std::filesystem::path& wanted, std::vector<std::filesystem::path>& paths) const;

  std::filesystem::path path_;
  const ImportOptions& options_;
  std::map<std::string, Texture> decoded_;
  std::map<std::pair<std::string, Sampling>, std::int32_t> indices_;
};

}  // namespace wiw::scene
