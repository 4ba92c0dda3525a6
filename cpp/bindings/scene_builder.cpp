// SPDX-License-Identifier: Apache-2.0
#include "scene_builder.hpp"

#include <pybind11/stl.h>

#include <algorithm>
#include <array>
#include <cstring>
#include <initializer_list>
#include <map>
#include <vector>

#include "arrays.hpp"
#include "wiw/scene/import/category.hpp"

namespace wiw::bindings {
namespace {

/// Rows of a [V, N] array under `key`; empty if the key is missing or None.
template <class T, int N>
std::vector<Eigen::Matrix<T, N, 1>> rows(const py::dict& dict, const char* key, const char* expected) {
  std::vector<Eigen::Matrix<T, N, 1>> result;
  if (!dict.contains(key) || dict[key].is_none()) return result;
  const auto array = dict[key].cast<Array<T>>();
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
  const auto array = value.cast<Array<std::uint8_t>>();
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
  scene->validate();
  return scene;
}

}  // namespace wiw::bindings
