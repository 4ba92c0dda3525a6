// SPDX-License-Identifier: Apache-2.0
#include "wiw/scene/sdf/model_finder.hpp"

#include <pugixml.hpp>

#include "wiw/scene/sdf/xml.hpp"

namespace wiw::scene::sdf {
namespace fs = std::filesystem;

ModelFinder::ModelFinder(const fs::path& world, const ImportOptions& options)
    : roots_(options.model_folders), options_(options) {
  const fs::path folder = fs::absolute(world).lexically_normal().parent_path();
  for (const fs::path& root : {folder.parent_path() / "models", folder / "models", folder, folder.parent_path()}) {
    roots_.push_back(root);
  }
}

fs::path ModelFinder::find(const std::string& uri, const fs::path& file) {
  const std::size_t scheme = uri.find("://");
  const bool beside_file = scheme == std::string::npos || uri.starts_with("file");
  const fs::path beside = beside_file ? file.parent_path() : fs::path();
  const auto [known, added] = found_.try_emplace({uri, beside});
  if (added) known->second = look_for(scheme == std::string::npos ? uri : uri.substr(scheme + 3), beside);
  return known->second;
}

fs::path ModelFinder::look_for(const std::string& path, const fs::path& beside) const {
  std::vector<fs::path> candidates;
  if (!beside.empty()) candidates.push_back(beside / path);
  for (const fs::path& root : roots_) candidates.push_back(root / path);
  for (const fs::path& candidate : candidates) {
    std::error_code ignored;
    if (fs::exists(candidate, ignored)) return candidate;
    if (options_.trace) options_.trace->absent.push_back(candidate);
  }
  return {};
}

fs::path ModelFinder::sdf_of(const fs::path& model) {
  const auto [known, added] = sdf_of_.try_emplace(model);
  if (added) known->second = read_config(model);
  return known->second;
}

fs::path ModelFinder::read_config(const fs::path& model) const {
  std::error_code ignored;
  if (!fs::is_directory(model, ignored)) return model;
  const fs::path config = model / "model.config";
  if (!fs::is_regular_file(config, ignored)) {
    if (options_.trace) options_.trace->absent.push_back(config);
    return model / "model.sdf";
  }
  const pugi::xml_document document = read_xml(config, options_);
  const std::string name = document.child("model").child_value("sdf");
  return model / (name.empty() ? "model.sdf" : name);
}

std::string ModelFinder::searched() const {
  std::string text;
  for (const fs::path& root : roots_) text += (text.empty() ? "" : ", ") + root.string();
  return text;
}

}  // namespace wiw::scene::sdf
