// SPDX-License-Identifier: Apache-2.0
#include "wiw/scene/measure.hpp"

namespace wiw::scene {
namespace {

template <class... T>
std::size_t bytes_of(const Buffer<T>&... buffers) {
  return (... + (buffers.size() * sizeof(T)));
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

}  // namespace wiw::scene
