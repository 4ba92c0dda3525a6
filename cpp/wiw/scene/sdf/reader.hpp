// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <pugixml.hpp>

#include "wiw/scene/sdf/model_finder.hpp"
#include "wiw/scene/sdf/world.hpp"

namespace wiw::sdf {

/// Walks a world file and the model files it includes.
class Reader {
 public:
  Reader(const std::filesystem::path& world, const ImportOptions& options);
  World read();

 private:
  /// One <model> or <include> on the way down from the world.
  struct Scope {
    std::string name;
    std::string kind;
    Eigen::Isometry3d T_world = Eigen::Isometry3d::Identity();
    std::filesystem::path file;
    int depth = 0;
  };

  pugi::xml_document parse(const std::filesystem::path& file);
  void read_children(const pugi::xml_node& parent, const Scope& scope);
  void read_model(const pugi::xml_node& element, const Scope& scope);
  void read_include(const pugi::xml_node& element, const Scope& parent);
  void read_visuals(const pugi::xml_node& link, const std::filesystem::path& file, Model& model);
  bool read_geometry(const pugi::xml_node& visual, const std::filesystem::path& file, Geometry& geometry);
  bool read_mesh(const pugi::xml_node& mesh, const std::filesystem::path& file, Geometry& geometry);
  void warn(const std::string& text);

  std::filesystem::path path_;
  const ImportOptions& options_;
  ModelFinder finder_;
  World world_;
};

}  // namespace wiw::sdf
