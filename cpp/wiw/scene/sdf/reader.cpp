// SPDX-License-Identifier: Apache-2.0
#include "wiw/scene/sdf/reader.hpp"

#include <algorithm>

#include "wiw/core/error.hpp"
#include "wiw/scene/sdf/materials.hpp"
#include "wiw/scene/sdf/pose.hpp"
#include "wiw/scene/sdf/xml.hpp"

namespace wiw::scene::sdf {
namespace fs = std::filesystem;
namespace {

constexpr int kMostNesting = 16;  // of models and includes; more is a circle

Eigen::Vector3d vector_of(const pugi::xml_node& element, const fs::path& file) {
  const auto v = numbers(element, 3, file);
  return {v[0], v[1], v[2]};
}

double positive(const pugi::xml_node& element, const fs::path& file) {
  const double value = numbers(element, 1, file)[0];
  if (value <= 0.)
    throw FileError(file.string(),
                    "<" + std::string(element.name()) + "> should be positive, got " + std::to_string(value));
  return value;
}

std::string joined(const std::string& outer, const std::string& inner) {
  return outer.empty() ? inner : outer + "/" + inner;
}

/// A model that only wraps one other lends it its name: the usual way to place an include.
bool only_wraps(const pugi::xml_node& model) {
  const auto models = std::distance(model.children("model").begin(), model.children("model").end());
  const auto includes = std::distance(model.children("include").begin(), model.children("include").end());
  return !model.child("link") && models + includes == 1;
}

}  // namespace

SdfReader::SdfReader(const fs::path& world, const ImportOptions& options)
    : path_(world), options_(options), finder_(world, options) {}

void SdfReader::warn(const std::string& text) {
  if (std::ranges::find(world_.warnings, text) == world_.warnings.end()) world_.warnings.push_back(text);
}

pugi::xml_node SdfReader::root_of(const fs::path& file) {
  const auto [known, added] = documents_.try_emplace(file);
  if (added) known->second = read_xml(file, options_);
  const pugi::xml_node root = known->second.child("sdf");
  if (!root) throw FileError(file.string(), "has no <sdf> element; expected a Gazebo world or model");
  return root;
}

void SdfReader::count_placed() {
  check_limit(path_.string(), "placed models and visuals", ++placed_, options_.limits.nodes, "nodes");
}

std::optional<Eigen::Isometry3d> SdfReader::pose_of(const pugi::xml_node& element, const fs::path& file) {
  try {
    return pose_in_model(element, file);
  } catch (const UnknownFrame& error) {
    warn(std::string(error.what()) + "; left out");
    return std::nullopt;
  }
}

SdfWorld SdfReader::read() {
  const pugi::xml_node root = root_of(path_);
  const pugi::xml_node world = root.child("world");
  world_.name = path_.stem().string();
  read_children(world ? world : root, {.file = path_});
  if (world_.models.empty()) {
    const std::string cause = world_.warnings.empty() ? "" : " (" + world_.warnings.front() + ")";
    throw FileError(path_.string(), "places no model that can be drawn" + cause);
  }
  return std::move(world_);
}

void SdfReader::read_children(const pugi::xml_node& parent, const Scope& scope) {
  if (scope.depth > kMostNesting) {
    throw FileError(scope.file.string(), "models are nested more than " + std::to_string(kMostNesting) +
                                             " deep (a model that includes itself?)");
  }
  for (const pugi::xml_node& child : parent.children()) {
    const std::string tag = child.name();
    if (tag == "include") read_include(child, scope);
    if (tag == "model") {
      const std::string name = child.attribute("name").as_string("model");
      const bool lends_name = scope.depth > 0 && only_wraps(parent);
      const auto pose = pose_of(child, scope.file);
      if (!pose) continue;
      read_model(child, {lends_name ? scope.name : joined(scope.name, name), name, scope.T_world * *pose, scope.file,
                         scope.depth + 1});
    }
    if (tag == "actor" || tag == "population" || tag == "road")
      warn("<" + tag + "> elements are not supported and left out");
  }
}

void SdfReader::read_include(const pugi::xml_node& element, const Scope& parent) {
  const std::string uri = element.child_value("uri");
  if (uri == "model://sun") return;  // a light, not a thing to draw
  const fs::path folder = finder_.find(uri, parent.file);
  if (folder.empty()) {
    warn("model '" + uri + "' was not found in " + finder_.searched() + "; left out");
    return;
  }
  const fs::path file = finder_.sdf_of(folder);
  const pugi::xml_node model = root_of(file).child("model");
  if (!model) throw FileError(file.string(), "holds no <model>");
  const std::string kind = model.attribute("name").as_string(folder.filename().c_str());
  const std::string own_name = element.child("name") ? element.child_value("name") : kind;
  const bool lends_name = parent.depth > 0 && only_wraps(element.parent());
  const auto pose = element.child("pose") ? pose_of(element, parent.file) : own_pose(model, file);
  const auto placed = placement(element, model, file);
  if (!pose || !placed) return;
  read_model(model, {lends_name ? parent.name : joined(parent.name, own_name), kind,
                     parent.T_world * *pose * placed->inverse(), file, parent.depth + 1});
}

std::optional<Eigen::Isometry3d> SdfReader::placement(const pugi::xml_node& include, const pugi::xml_node& model,
                                                      const fs::path& file) {
  const std::string outer = include.child_value("placement_frame");
  const std::string frame = outer.empty() ? model.attribute("placement_frame").value() : outer;
  if (frame.empty()) return Eigen::Isometry3d::Identity();
  try {
    return frame_in_model(model, frame, file);
  } catch (const UnknownFrame& error) {
    warn(std::string(error.what()) + "; left out");
    return std::nullopt;
  }
}

void SdfReader::read_model(const pugi::xml_node& element, const Scope& scope) {
  count_placed();
  Model model{scope.name, scope.kind, scope.T_world, {}};
  for (const pugi::xml_node& link : element.children("link")) read_visuals(link, scope.file, model);
  if (!model.visuals.empty()) world_.models.push_back(std::move(model));
  read_children(element, scope);
}

void SdfReader::read_visuals(const pugi::xml_node& link, const fs::path& file, Model& model) {
  for (const pugi::xml_node& element : link.children("visual")) {
    count_placed();
    const auto pose = pose_of(element, file);
    if (!pose) continue;
    ModelVisual visual;
    visual.T_model_visual = *pose;
    if (!read_geometry(element.child("geometry"), file, visual.geometry)) continue;
    std::vector<std::string> warnings;
    visual.color = material_color(element, file, warnings);
    for (const std::string& warning : warnings) warn(warning);
    model.visuals.push_back(std::move(visual));
  }
}

bool SdfReader::read_geometry(const pugi::xml_node& element, const fs::path& file, Geometry& geometry) {
  const pugi::xml_node shape = element.first_child();
  const std::string tag = shape.name();
  if (tag == "mesh") return read_mesh(shape, file, geometry);
  if (tag == "box") {
    geometry.shape = ShapeKind::kBox;
    geometry.size = vector_of(shape.child("size"), file);
  } else if (tag == "sphere") {
    geometry.shape = ShapeKind::kSphere;
    geometry.size.setConstant(positive(shape.child("radius"), file));
  } else if (tag == "cylinder") {
    geometry.shape = ShapeKind::kCylinder;
    const double radius = positive(shape.child("radius"), file);
    geometry.size = {radius, radius, positive(shape.child("length"), file)};
  } else if (tag == "plane") {
    geometry.shape = ShapeKind::kPlane;
    const auto size = numbers(shape.child("size"), 2, file);
    geometry.size = {size[0], size[1], 1.};
    if (shape.child("normal")) geometry.normal = vector_of(shape.child("normal"), file).normalized();
  } else {
    if (tag != "empty") warn("<" + tag + "> geometry is not supported and left out");
    return false;
  }
  return true;
}

bool SdfReader::read_mesh(const pugi::xml_node& mesh, const fs::path& file, Geometry& geometry) {
  const std::string uri = mesh.child_value("uri");
  geometry.shape = ShapeKind::kMesh;
  geometry.mesh = finder_.find(uri, file);
  geometry.submesh = mesh.child("submesh").child_value("name");
  if (mesh.child("scale")) geometry.size = vector_of(mesh.child("scale"), file);
  std::error_code ignored;
  if (fs::is_regular_file(geometry.mesh, ignored)) return true;
  warn("mesh '" + uri + "' was not found in " + finder_.searched() + "; left out");
  return false;
}

}  // namespace wiw::scene::sdf
