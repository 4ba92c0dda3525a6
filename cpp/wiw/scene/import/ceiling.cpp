// SPDX-License-Identifier: Apache-2.0
#include "wiw/scene/import/ceiling.hpp"

#include <algorithm>
#include <cmath>
#include <vector>

#include "wiw/core/error.hpp"
#include "wiw/scene/import/category.hpp"
#include "wiw/scene/measure.hpp"

namespace wiw::scene {
namespace {

Eigen::AlignedBox3f floor_bounds(const Scene& scene) {
  Eigen::AlignedBox3f box;
  const auto floor = std::ranges::find(scene.categories, "floor");
  const auto category = static_cast<std::int32_t>(floor - scene.categories.begin());
  for (const Instance& instance : scene.instances) {
    if (floor == scene.categories.end() || instance.category != category) continue;
    box.extend(instance_bounds(scene, instance));
  }
  return box;
}

}  // namespace

void add_ceiling(Scene& scene, float height) {
  if (!std::isfinite(height) || height <= 0.f) {
    throw ArgumentError("ceiling height must be positive metres above the floor, got " + std::to_string(height));
  }
  const Eigen::AlignedBox3f all = scene.bounds();
  const Eigen::AlignedBox3f floor = floor_bounds(scene);
  const float y = height + (floor.isEmpty() ? all.min().y() : floor.max().y());
  const Eigen::Vector3f& a = all.min();
  const Eigen::Vector3f& b = all.max();

  Mesh mesh;
  mesh.positions =
      std::vector<Eigen::Vector3f>{{a.x(), y, a.z()}, {b.x(), y, a.z()}, {b.x(), y, b.z()}, {a.x(), y, b.z()}};
  mesh.normals = std::vector<Eigen::Vector3f>(4, -Eigen::Vector3f::UnitY());
  mesh.triangles = std::vector<Eigen::Matrix<std::uint32_t, 3, 1>>{{0, 1, 2}, {0, 2, 3}};
  mesh.material = static_cast<std::int32_t>(scene.materials.size());
  scene.materials.push_back({.name = "ceiling", .base_color = {0.92f, 0.92f, 0.9f, 1.f}});
  scene.meshes.push_back(std::move(mesh));

  Instance instance;
  instance.id = static_cast<std::uint32_t>(scene.instances.size() + 1);
  instance.name = "ceiling";
  instance.category = category_index(scene, "ceiling");
  instance.meshes = {static_cast<std::uint32_t>(scene.meshes.size() - 1)};
  scene.instances.push_back(std::move(instance));
}

}  // namespace wiw::scene
