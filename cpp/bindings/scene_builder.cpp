// SPDX-License-Identifier: Apache-2.0
#include "scene_builder.hpp"

#include <pybind11/stl.h>

#include <algorithm>
#include <array>
#include <cstring>
#include <initializer_list>
#include <map>
#include <tuple>
#include <type_traits>
#include <utility>
#include <vector>

#include "arrays.hpp"
#include "gil.hpp"
#include "wiw/scene/assemble.hpp"
#include "wiw/scene/import/category.hpp"
#include "wiw/scene/relabel.hpp"
#include "wiw/scene/text.hpp"

namespace wiw::bindings {
namespace {

/// Rows of a [V, N] array under `key`; empty if the key is missing or None.
template <class T, int N>
std::vector<Eigen::Matrix<T, N, 1>> rows(const py::dict& dict, const char* key, const char* expected) {
  std::vector<Eigen::Matrix<T, N, 1>> result;
  if (!dict.contains(key) || dict[key].is_none()) return result;
  Array<T> array;
  if constexpr (std::is_integral_v<T>) {
    array = to_integers<T>(dict[key], expected);
  } else {
    array = dict[key].cast<Array<T>>();
  }
  expect_shape(array, {-1, N}, expected);
  result.resize(static_cast<std::size_t>(array.shape(0)));
  if (!result.empty()) std::memcpy(static_cast<void*>(result.data()), array.data(), result.size() * sizeof(result[0]));
  return result;
}

template <class T>
T value_or(const py::dict& dict, const char* key, T fallback) {
  if (!dict.contains(key) || dict[key].is_none()) return fallback;
  return dict[key].cast<T>();
}

void check_keys(const py::dict& dict, std::initializer_list<const char*> known, const char* what) {
  for (const auto& [key, value] : dict) {
    const auto name = key.cast<std::string>();
    if (std::ranges::find(known, name) == known.end()) throw ArgumentError("'" + name + "' is no key of a " + what);
  }
}

scene::Texture texture_from(const py::handle& value, std::size_t index) {
  const auto array = to_integers<std::uint8_t>(value, "a texture uint8 [H, W, 4]");
  expect_shape(array, {-1, -1, 4}, "a texture uint8 [H, W, 4]");
  const Size size{static_cast<int>(array.shape(0)), static_cast<int>(array.shape(1))};
  std::vector<std::uint8_t> rgba(array.data(), array.data() + array.size());
  return {"texture " + std::to_string(index), size, std::move(rgba)};
}

scene::Material material_from(const py::dict& dict) {
  check_keys(dict, {"name", "base_color", "texture", "alpha_cutoff", "emissive"}, "material");
  scene::Material material;
  material.name = value_or<std::string>(dict, "name", "");
  const auto color = value_or<std::array<float, 4>>(dict, "base_color", {1.f, 1.f, 1.f, 1.f});
  material.base_color = {color[0], color[1], color[2], color[3]};
  material.texture = value_or(dict, "texture", scene::kNone);
  material.alpha_cutoff = value_or(dict, "alpha_cutoff", -1.f);
  material.emissive = value_or(dict, "emissive", false);
  return material;
}

scene::Mesh mesh_from(const py::dict& dict) {
  check_keys(dict,
             {"positions", "triangles", "normals", "uv", "lightmap_uv", "colors", "material", "lightmap", "name",
              "category", "attributes", "T_world_instance"},
             "mesh");
  scene::Mesh mesh;
  mesh.positions = rows<float, 3>(dict, "positions", "positions float32 [V, 3]");
  mesh.triangles = rows<std::uint32_t, 3>(dict, "triangles", "triangles uint32 [T, 3]");
  mesh.normals = rows<float, 3>(dict, "normals", "normals float32 [V, 3]");
  mesh.uv = rows<float, 2>(dict, "uv", "uv float32 [V, 2]");
  mesh.lightmap_uv = rows<float, 2>(dict, "lightmap_uv", "lightmap_uv float32 [V, 2]");
  mesh.colors = rows<std::uint8_t, 4>(dict, "colors", "colors uint8 [V, 4]");
  mesh.material = value_or(dict, "material", scene::kNone);
  mesh.lightmap = value_or(dict, "lightmap", scene::kNone);
  return mesh;
}

/// A dict's [4, 4] or [N, 4, 4] transforms; one identity if it has none.
std::vector<Eigen::Affine3f> placements(const py::dict& dict) {
  if (!dict.contains("T_world_instance") || dict["T_world_instance"].is_none()) return {Eigen::Affine3f::Identity()};
  std::vector<Eigen::Affine3f> result;
  for (const Pose& pose : to_poses(dict["T_world_instance"].cast<Array<double>>(), "T_world_instance")) {
    result.emplace_back(pose.matrix().cast<float>());
  }
  return result;
}

void add_instances(const py::dict& dict, scene::Scene& scene) {
  const auto mesh = static_cast<std::uint32_t>(scene.meshes.size() - 1);
  for (const Eigen::Affine3f& T_world_instance : placements(dict)) {
    scene::Instance instance;
    instance.id = static_cast<std::uint32_t>(scene.instances.size() + 1);
    instance.name = value_or<std::string>(dict, "name", "mesh " + std::to_string(mesh));
    instance.category = scene::category_index(scene, value_or<std::string>(dict, "category", ""));
    instance.attributes = value_or<std::map<std::string, std::string>>(dict, "attributes", {});
    instance.meshes = {mesh};
    instance.T_world_instance = T_world_instance;
    scene.instances.push_back(std::move(instance));
  }
}

scene::Sun sun_from(const py::dict& dict) {
  check_keys(dict, {"direction", "strength", "ambient"}, "sun");
  scene::Sun sun;
  if (dict.contains("direction")) {
    const auto array = dict["direction"].cast<Array<double>>();
    expect_shape(array, {3}, "the sun's direction [3]");
    const Eigen::Vector3d direction(array.at(0), array.at(1), array.at(2));
    if (!(direction.stableNorm() > 0.0) || !direction.allFinite()) {
      throw ArgumentError("the sun's direction must be finite and not zero");
    }
    sun.direction = direction.stableNormalized().cast<float>();
  }
  sun.strength = value_or(dict, "strength", sun.strength);
  sun.ambient = value_or(dict, "ambient", sun.ambient);
  return sun;
}

/// Name, category and attributes of a dict; the category goes into `categories`.
scene::Instance instance_from(const py::dict& dict, scene::Scene& categories) {
  check_keys(dict, {"name", "category", "attributes"}, "instance");
  scene::Instance instance;
  instance.name = value_or<std::string>(dict, "name", "");
  instance.category = scene::category_index(categories, value_or<std::string>(dict, "category", ""));
  instance.attributes = value_or<std::map<std::string, std::string>>(dict, "attributes", {});
  return instance;
}

scene::Room room_from(const py::dict& dict) {
  check_keys(dict, {"name", "type", "bounds"}, "room");
  const auto bounds = dict["bounds"].cast<Array<float>>();
  expect_shape(bounds, {2, 3}, "a room's bounds [2, 3]");
  return {dict["name"].cast<std::string>(),
          dict["type"].cast<std::string>(),
          {Eigen::Vector3f(bounds.at(0, 0), bounds.at(0, 1), bounds.at(0, 2)),
           Eigen::Vector3f(bounds.at(1, 0), bounds.at(1, 1), bounds.at(1, 2))}};
}

std::vector<scene::LabelledPiece> pieces_from(const py::array& labels, const py::object& triangles,
                                              const py::object& corners) {
  const auto instances = to_integers<std::uint32_t>(labels, "labels uint32 [P]");
  expect_shape(instances, {-1}, "labels uint32 [P]");
  std::vector<scene::LabelledPiece> pieces(static_cast<std::size_t>(instances.size()));
  for (std::size_t i = 0; i < pieces.size(); ++i) {
    pieces[i].triangle = static_cast<std::uint32_t>(i);
    pieces[i].instance = instances.data()[i];
  }
  if (!triangles.is_none()) {
    const auto numbers = to_integers<std::uint32_t>(triangles, "triangles uint32 [P], one for each label");
    expect_shape(numbers, {instances.size()}, "triangles uint32 [P], one for each label");
    for (std::size_t i = 0; i < pieces.size(); ++i) pieces[i].triangle = numbers.data()[i];
  }
  if (!corners.is_none()) {
    const auto weights = corners.cast<Array<float>>();
    expect_shape(weights, {instances.size(), 3, 3}, "corners float32 [P, 3, 3], for each label");
    for (std::size_t i = 0; i < pieces.size(); ++i) {
      pieces[i].corners = Eigen::Map<const Eigen::Matrix<float, 3, 3, Eigen::RowMajor>>(weights.data() + 9 * i);
    }
  }
  return pieces;
}

}  // namespace

std::shared_ptr<scene::Scene> scene_from_arrays(const py::list& meshes, const std::string& name,
                                                const py::list& textures, const py::list& materials,
                                                const std::optional<py::dict>& sun) {
  auto scene = std::make_shared<scene::Scene>();
  scene->name = name;
  scene->attributes["up"] = "Y (given as arrays)";
  for (const py::handle& texture : textures) scene->textures.push_back(texture_from(texture, scene->textures.size()));
  for (const py::handle& material : materials) scene->materials.push_back(material_from(material.cast<py::dict>()));
  for (const py::handle& mesh : meshes) {
    const auto dict = mesh.cast<py::dict>();
    scene->meshes.push_back(mesh_from(dict));
    add_instances(dict, *scene);
  }
  if (sun) scene->sun = sun_from(*sun);
  const GilRelease release;
  scene->validate();
  return scene;
}

namespace {

scene::SceneLabels labels_from(const py::list& instances, const py::list& rooms) {
  scene::SceneLabels labels;
  scene::Scene categories;
  for (const py::handle& entry : instances) {
    labels.instances.push_back(instance_from(entry.cast<py::dict>(), categories));
  }
  labels.categories = std::move(categories.categories);
  for (const py::handle& room : rooms) labels.rooms.push_back(room_from(room.cast<py::dict>()));
  return labels;
}

/// Fills in what is said of the scene as a whole: "name", "attributes", "warnings" and "flat".
void describe_scene(const py::dict& about, scene::Scene& scene) {
  check_keys(about, {"name", "attributes", "warnings", "flat"}, "scene");
  if (value_or(about, "flat", false)) {
    for (scene::Material& material : scene.materials) material.emissive = true;
  }
  scene.name = value_or(about, "name", scene.name);
  for (const auto& [key, value] : value_or<std::map<std::string, std::string>>(about, "attributes", {})) {
    scene.attributes[key] = value;
  }
  const auto warnings = value_or<std::vector<std::string>>(about, "warnings", {});
  scene.warnings.insert(scene.warnings.end(), warnings.begin(), warnings.end());
  scene::make_text_utf8(scene);
}

}  // namespace

std::shared_ptr<scene::Scene> relabelled_scene(const scene::Scene& scene, const py::list& instances,
                                               const py::array& labels, const py::object& triangles,
                                               const py::object& corners, const py::list& rooms,
                                               const py::kwargs& about) {
  const auto pieces = pieces_from(labels, triangles, corners);
  scene::SceneLabels names = labels_from(instances, rooms);
  auto result = [&] {
    const GilRelease release;
    return std::const_pointer_cast<scene::Scene>(relabel(scene, pieces, std::move(names)));
  }();
  describe_scene(about, *result);
  return result;
}

std::shared_ptr<scene::Scene> assembled_scene(const std::vector<std::shared_ptr<scene::Scene>>& parts,
                                              const py::list& placements, const py::list& instances,
                                              const py::list& rooms, const py::kwargs& about) {
  std::vector<scene::Placement> placed;
  for (const py::handle& entry : placements) {
    const auto [part, instance, matrix] = entry.cast<std::tuple<std::uint32_t, std::uint32_t, Array<double>>>();
    expect_shape(matrix, {4, 4}, "a placement's transform [4, 4]");
    const Eigen::Map<const Eigen::Matrix<double, 4, 4, Eigen::RowMajor>> map(matrix.data());
    if (!map.allFinite()) throw ArgumentError("a placement's transform is not finite");
    placed.push_back({part, instance, Eigen::Affine3f(map.cast<float>())});
  }
  const std::vector<scene::ScenePtr> models(parts.begin(), parts.end());
  scene::SceneLabels names = labels_from(instances, rooms);
  auto result = [&] {
    const GilRelease release;
    return std::const_pointer_cast<scene::Scene>(assemble(models, placed, std::move(names)));
  }();
  describe_scene(about, *result);
  return result;
}

}  // namespace wiw::bindings
