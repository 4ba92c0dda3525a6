// SPDX-License-Identifier: Apache-2.0
#include "wiw/scene/sdf/model_finder.hpp"

#include <pugixml.hpp>

namespace wiw::sdf {
namespace fs = std::filesystem;

ModelFinder::ModelFinder(const fs::path& world, const ImportOptions& options)
    : roots_(options.model_folders), trace_(options.trace) {
  const fs::path folder = fs::absolute(world).lexically_normal().parent_path();
  for (const fs::path& root : {folder.parent_path() / "models", folder / "models", folder, folder.parent_path()}) {
    roots_.push_back(root);
  }
}

fs::path ModelFinder::find(const std::string& uri, const fs::path& file) const {
  const std::size_t scheme = uri.find("://");
  const std::string rest = scheme == std::string::npos ? uri : uri.substr(scheme + 3);
  const bool beside_file = scheme == std::string::npos || uri.starts_with("file");
  std::vector<fs::path> candidates;
  if (beside_file) candidates.push_back(file.parent_path() / rest);
  for (const fs::path& root : roots_) candidates.push_back(root / rest);
  for (const fs::path& candidate : candidates) {
    std::error_code ignored;
    if (fs::exists(candidate, ignored)) return candidate;
    if (trace_) trace_->absent.push_back(candidate);
  }
  return {};
}

fs::path ModelFinder::sdf_of(const fs::path& model) const {
  if (!fs::is_directory(model)) return model;
  const fs::path config = model / "model.config";
  pugi::xml_document document;
  if (document.load_file(config.c_str())) {
    if (trace_) trace_->read.push_back(config);
    const std::string name = document.child("model").child_value("sdf");
    if (!name.empty()) return model / name;
  }
  return model / "model.sdf";
}

std::string ModelFinder::searched() const {
  std::string text;
  for (const fs::path& root : roots_) text += (text.empty() ? "" : ", ") + root.string();
  return text;
}

}  // namespace wiw::sdf
