// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <filesystem>
#include <map>
#include <string>
#include <utility>
#include <vector>

#include "wiw/scene/import.hpp"

namespace wiw::scene::sdf {

/// Turns the URIs of a world into paths, each looked for once.
class ModelFinder {
 public:
  ModelFinder(const std::filesystem::path& world, const ImportOptions& options);

  /// `model://NAME/rest`, `file://path`, `package://NAME/rest` or a path; relative ones are tried beside `file` first.
  /// Empty if nothing is there.
  [[nodiscard]] std::filesystem::path find(const std::string& uri, const std::filesystem::path& file);

  /// The SDF file of a model folder: as model.config says, else model.sdf. A path to a file is taken as it is.
  /// Throws FileError for a model.config that is no XML.
  [[nodiscard]] std::filesystem::path sdf_of(const std::filesystem::path& model);

  /// "models, ../models": the folders searched, for messages.
  [[nodiscard]] std::string searched() const;

 private:
  [[nodiscard]] std::filesystem::path look_for(const std::string& path, const std::filesystem::path& beside) const;
  [[nodiscard]] std::filesystem::path read_config(const std::filesystem::path& model) const;

  std::vector<std::filesystem::path> roots_;
  std::map<std::pair<std::string, std::filesystem::path>, std::filesystem::path> found_;  // of a URI and a folder
  std::map<std::filesystem::path, std::filesystem::path> sdf_of_;                         // of a model folder
  const ImportOptions& options_;
};

}  // namespace wiw::scene::sdf
