// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <map>
#include <optional>
#include <pugixml.hpp>

#include "wiw/scene/sdf/model_finder.hpp"
#include "wiw/scene/sdf/world.hpp"

namespace wiw::scene::sdf {

/// Walks a world file and the model files it includes.
class SdfReader {
 public:
  SdfReader(const std::filesystem::path& world, const ImportOptions& options);
  SdfWorld read();

 private:
  /// One <model> or <include> on the way down from the world.
  struct Scope {
    std::string name;
    std::string kind;
    Eigen::Isometry3d T_world = Eigen::Isometry3d::Identity();
    std::filesystem::path file;
    int depth = 0;
  };

  /// The <sdf> element of a file, which is parsed once.
  pugi::xml_node root_of(const std::filesystem::path& file);
  void count_placed();
  /// Empty, with a warning, if the pose is relative to nothing that is there.
  std::optional<Eigen::Isometry3d> pose_of(const pugi::xml_node& element, const std::filesystem::path& file);
  /// Pose in an included model of the frame that the include's pose places; empty, with a warning, as above.
  std::optional<Eigen::Isometry3d> placement(const pugi::xml_node& include, const pugi::xml_node& model,
                                             const std::filesystem::path& file);
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
  SdfWorld world_;
  std::map<std::filesystem::path, pugi::xml_document> documents_;
  std::size_t placed_ = 0;
};

}  // namespace wiw::scene::sdf
