// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <filesystem>
#include <string>
#include <vector>

#include "wiw/scene/import.hpp"

namespace wiw::sdf {

/// Turns the URIs of a world into paths.
class ModelFinder {
 public:
  ModelFinder(const std::filesystem::path& world, const ImportOptions& options);

  /// `model://NAME/rest`, `file://path`, `package://NAME/rest` or a path; relative ones are tried beside `file` first.
  /// Empty if nothing is there.
  [[nodiscard]] std::filesystem::path find(const std::string& uri, const std::filesystem::path& file) const;

  /// The SDF file of a model folder: as model.config says, else model.sdf. A path to a file is taken as it is.
  [[nodiscard]] std::filesystem::path sdf_of(const std::filesystem::path& model) const;

  /// "models, ../models": the folders searched, for messages.
  [[nodiscard]] std::string searched() const;

 private:
  std::vector<std::filesystem::path> roots_;
  ImportTrace* trace_;
};

}  // namespace wiw::sdf
