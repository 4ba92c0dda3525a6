// SPDX-License-Identifier: Apache-2.0
#include "wiw/scene/scene.hpp"

#include <cmath>
#include <utility>

#include "wiw/core/error.hpp"

namespace wiw::scene {

std::size_t Scene::triangle_count() const {
  std::size_t count = 0;
  for (const Instance& instance : instances) {
    for (const std::uint32_t mesh : instance.meshes) count += meshes[mesh].triangles.size();
  }
  return count;
}

Eigen::AlignedBox3f Scene::bounds() const {
  Eigen::AlignedBox3f box;
  for (const Instance& instance : instances) {
    for (const std::uint32_t mesh : instance.meshes) {
      for (const auto& position : meshes[mesh].positions) box.extend(instance.T_world_instance * position);
    }
  }
  return box;
}

namespace {

void check_index(std::int32_t index, std::size_t size, const std::string& what) {
  if (index < kNone || index >= static_cast<std::int32_t>(size)) {
    throw ArgumentError("Scene: " + what + " is " + std::to_string(index) + ", but there are only " +
                        std::to_string(size));
  }
}

template <class T>
void check_length(const Buffer<T>& values, std::size_t vertices, const std::string& what) {
  if (!values.empty() && values.size() != vertices) {
    throw ArgumentError("Scene: " + what + " has " + std::to_string(values.size()) + " entries for " +
                        std::to_string(vertices) + " vertices");
  }
}

void check_mesh(const Scene& scene, const Mesh& mesh, const std::string& name) {
  check_index(mesh.material, scene.materials.size(), name + ".material");
  check_index(mesh.lightmap, scene.textures.size(), name + ".lightmap");
  const std::size_t vertices = mesh.positions.size();
  check_length(mesh.normals, vertices, name + ".normals");
  check_length(mesh.uv, vertices, name + ".uv");
  check_length(mesh.lightmap_uv, vertices, name + ".lightmap_uv");
  check_length(mesh.colors, vertices, name + ".colors");
  for (const auto& position : mesh.positions) {
    if (!position.allFinite()) throw ArgumentError("Scene: " + name + " has a vertex that is not finite");
  }
  for (const auto& triangle : mesh.triangles) {
    if (triangle.maxCoeff() >= vertices) {
      throw ArgumentError("Scene: " + name + " has a triangle with vertex " + std::to_string(triangle.maxCoeff()) +
                          ", but only " + std::to_string(vertices) + " vertices");
    }
  }
}

void check_sun(const Sun& sun) {
  if (!(std::abs(sun.direction.norm() - 1.f) < 1e-3f)) {
    throw ArgumentError("Scene: the sun's direction must have length 1, got " + std::to_string(sun.direction.norm()));
  }
  for (const auto& [name, value] : {std::pair{"strength", sun.strength}, std::pair{"ambient", sun.ambient}}) {
    if (value >= 0.f && value <= 1.f) continue;
    throw ArgumentError("Scene: the sun's " + std::string(name) + " must be in [0, 1], got " + std::to_string(value));
  }
}

void check_placed(const char* what, std::size_t count, std::size_t most) {
  if (count <= most) return;
  throw ArgumentError("Scene: the placements of its meshes sum to more than " + std::to_string(most) + " " + what +
                      "; place fewer meshes, or meshes of fewer " + what);
}

}  // namespace

void Scene::validate() const {
  if (sun) check_sun(*sun);
  for (const Texture& texture : textures) {
    if (texture.size.height < 1 || texture.size.width < 1 || texture.rgba.size() != 4 * texture.size.pixels()) {
      throw ArgumentError("Scene: texture '" + texture.name + "' has a size that does not fit its data");
    }
  }
  for (const Material& material : materials)
    check_index(material.texture, textures.size(), "texture of '" + material.name + "'");
  for (std::size_t i = 0; i < meshes.size(); ++i) check_mesh(*this, meshes[i], "mesh " + std::to_string(i));
  std::size_t vertices = 0, triangles = 0;
  for (std::size_t i = 0; i < instances.size(); ++i) {
    const Instance& instance = instances[i];
    if (instance.id != i + 1)
      throw ArgumentError("Scene: instance '" + instance.name + "' must have id " + std::to_string(i + 1));
    check_index(instance.category, categories.size(), "category of '" + instance.name + "'");
    for (const std::uint32_t mesh : instance.meshes) {
      if (mesh >= meshes.size()) {
        throw ArgumentError("Scene: mesh of '" + instance.name + "' is " + std::to_string(mesh) +
                            ", but there are only " + std::to_string(meshes.size()));
      }
      vertices += meshes[mesh].positions.size();
      triangles += meshes[mesh].triangles.size();
      check_placed("vertices", vertices, kMostPlacedVertices);
      check_placed("triangles", triangles, kMostPlacedTriangles);
    }
    if (!instance.T_world_instance.matrix().allFinite()) {
      throw ArgumentError("Scene: the pose of '" + instance.name + "' is not finite");
    }
  }
}

TriangleSoup world_triangles(const Scene& scene) {
  TriangleSoup soup;
  for (const Instance& instance : scene.instances) {
    for (const std::uint32_t index : instance.meshes) {
      const Mesh& mesh = scene.meshes[index];
      const auto base = static_cast<std::uint32_t>(soup.vertices.size());
      for (const auto& position : mesh.positions) soup.vertices.emplace_back(instance.T_world_instance * position);
      for (const auto& triangle : mesh.triangles) {
        soup.triangles.emplace_back((triangle.array() + base).matrix());
        soup.instance.push_back(instance.id);
      }
    }
  }
  return soup;
}

}  // namespace wiw::scene
