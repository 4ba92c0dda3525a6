// SPDX-License-Identifier: Apache-2.0
#include "wiw/scene/measure.hpp"

namespace wiw::scene {
namespace {

template <class... T>
std::size_t bytes_of(const Buffer<T>&... buffers) {
  return (... + (buffers.size() * sizeof(T)));
}

double area_of(const Mesh& mesh) {
  double area = 0;
  for (const Triangle& triangle : mesh.triangles) {
    const Eigen::Vector3f& a = mesh.positions[triangle[0]];
    area += 0.5 * static_cast<double>((mesh.positions[triangle[1]] - a).cross(mesh.positions[triangle[2]] - a).norm());
  }
  return area;
}

}  // namespace

Eigen::AlignedBox3f instance_bounds(const Scene& scene, const Instance& instance) {
  Eigen::AlignedBox3f box;
  for (const std::uint32_t mesh : instance.meshes) {
    for (const auto& position : scene.meshes[mesh].positions) box.extend(instance.T_world_instance * position);
  }
  return box;
}

std::size_t texture_bytes(const Scene& scene) {
  std::size_t bytes = 0;
  for (const Texture& texture : scene.textures) bytes += texture.rgba.size();
  return bytes;
}

std::size_t mesh_bytes(const Scene& scene) {
  std::size_t bytes = 0;
  for (const Mesh& mesh : scene.meshes) {
    bytes += bytes_of(mesh.positions, mesh.normals, mesh.uv, mesh.lightmap_uv, mesh.colors, mesh.triangles);
  }
  return bytes;
}

double missing_texture_share(const Scene& scene) {
  double all = 0;
  double missing = 0;
  for (const Instance& instance : scene.instances) {  // placements are rigid
    for (const std::uint32_t index : instance.meshes) {
      const Mesh& mesh = scene.meshes[index];
      const double area = area_of(mesh);
      all += area;
      if (mesh.material != kNone && scene.materials[mesh.material].texture_missing) missing += area;
    }
  }
  return all > 0 ? missing / all : 0;
}

}  // namespace wiw::scene
