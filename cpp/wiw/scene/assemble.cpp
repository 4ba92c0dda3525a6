// SPDX-License-Identifier: Apache-2.0
#include "wiw/scene/assemble.hpp"

#include <string>
#include <utility>
#include <vector>

#include "wiw/core/error.hpp"
#include "wiw/scene/import/mesh_baker.hpp"

namespace wiw::scene {

std::int32_t add_appearance(const Scene& part, Scene& scene) {
  const auto first_texture = static_cast<std::int32_t>(scene.textures.size());
  const auto first_material = static_cast<std::int32_t>(scene.materials.size());
  scene.textures.insert(scene.textures.end(), part.textures.begin(), part.textures.end());
  for (Material material : part.materials) {
    if (material.texture != kNone) material.texture += first_texture;
    scene.materials.push_back(std::move(material));
  }
  scene.warnings.insert(scene.warnings.end(), part.warnings.begin(), part.warnings.end());
  return first_material;
}

namespace {

/// A placement as a rigid pose, then what is baked into the vertices.
struct SplitPose {
  Eigen::Affine3f rigid;
  Eigen::Affine3f rest;
};

SplitPose split(const Eigen::Affine3f& map) {
  const auto [rotation, stretch] = split_rotation(map.linear());
  SplitPose result{Eigen::Affine3f(rotation), Eigen::Affine3f(stretch)};
  result.rigid.translation() = map.translation();
  return result;
}

void check(const Placement& placement, std::size_t parts, std::size_t instances) {
  if (placement.part < parts && placement.instance >= 1 && placement.instance <= instances) return;
  throw ArgumentError("assemble: a placement names part " + std::to_string(placement.part) + " of " +
                      std::to_string(parts) + " and instance " + std::to_string(placement.instance) + " of " +
                      std::to_string(instances));
}

}  // namespace

ScenePtr assemble(std::span<const ScenePtr> parts, std::span<const Placement> placements, SceneLabels labels) {
  auto scene = std::make_shared<Scene>();
  set_labels(std::move(labels), *scene);
  std::vector<std::int32_t> first_materials;
  for (const ScenePtr& part : parts) first_materials.push_back(add_appearance(*part, *scene));
  MeshBaker baker(*scene);
  for (const Placement& placement : placements) {
    check(placement, parts.size(), scene->instances.size());
    Instance& instance = scene->instances[placement.instance - 1];
    auto [rigid, rest] = split(placement.T_world_part);
    if (instance.meshes.empty()) {
      instance.T_world_instance = rigid;
    } else {
      rest = instance.T_world_instance.inverse() * placement.T_world_part;
    }
    for (const Instance& node : parts[placement.part]->instances) {
      for (const std::uint32_t index : node.meshes) {
        const Mesh& mesh = parts[placement.part]->meshes[index];
        const std::int32_t material = mesh.material == kNone ? kNone : mesh.material + first_materials[placement.part];
        instance.meshes.push_back(baker.bake(mesh, rest * node.T_world_instance, material));
      }
    }
  }
  scene->validate();
  return scene;
}

}  // namespace wiw::scene
