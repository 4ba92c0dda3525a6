// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstddef>
#include <cstdint>
#include <string>
#include <utility>
#include <vector>

#include "wiw/scene/scene.hpp"

namespace wiw::scene {

/// What a scene consists of besides its surface. Ids, meshes and poses of the instances are filled in by who places
/// them; a category is an index into `categories`.
struct SceneLabels {
  std::vector<Instance> instances;
  std::vector<std::string> categories;
  std::vector<Room> rooms;
};

/// Gives a scene these instances, numbered, without meshes and at the origin.
inline void set_labels(SceneLabels labels, Scene& scene) {
  scene.instances = std::move(labels.instances);
  scene.categories = std::move(labels.categories);
  scene.rooms = std::move(labels.rooms);
  for (std::size_t i = 0; i < scene.instances.size(); ++i) {
    Instance& instance = scene.instances[i];
    instance.id = static_cast<std::uint32_t>(i + 1);
    instance.meshes.clear();
    instance.T_world_instance.setIdentity();
  }
}

}  // namespace wiw::scene
