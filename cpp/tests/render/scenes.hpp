// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstdint>
#include <vector>

#include "wiw/render/renderer.hpp"

/// Small scenes whose pictures are known in closed form, and the buffers to draw them into.
namespace wiw::testing {

/// Grows a scene one instance at a time; every instance has one mesh.
class SceneBuilder {
 public:
  SceneBuilder();
  std::int32_t add_texture(Size size, const std::vector<std::uint8_t>& rgba);
  std::int32_t add_material(const scene::Material& material);
  std::uint32_t add_instance(scene::Mesh mesh, const Eigen::Affine3f& T_world_instance = Eigen::Affine3f::Identity());
  [[nodiscard]] scene::ScenePtr build() const;

  scene::Scene scene;
};

/// Rectangle corner + s * across + t * along with uv = (s, t) * repeats, and the same uv in [0, 1] for a lightmap.
scene::Mesh make_quad(const Eigen::Vector3f& corner, const Eigen::Vector3f& across, const Eigen::Vector3f& along,
                      float repeats = 1.f);

/// Axis-aligned box, all six sides in one mesh.
scene::Mesh make_box(const Eigen::Vector3f& low, const Eigen::Vector3f& high);

/// Latitude-longitude sphere around the origin with smooth normals; chords lie at most radius * (pi / rings)^2 / 2
/// inside.
scene::Mesh make_sphere(float radius, int rings);

/// A room with a box of its own id for each wall (ids 1-6: x low, x high, floor, ceiling, z low, z high), corner to
/// corner.
scene::ScenePtr make_room(const Eigen::Vector3f& low, const Eigen::Vector3f& high);

/// Square texture of `cells` x `cells` black and white cells.
std::vector<std::uint8_t> checkerboard(int side, int cells);

struct Picture {
  std::vector<std::uint8_t> color;
  std::vector<float> depth;
  std::vector<std::uint32_t> instance;
  Size size;

  [[nodiscard]] std::size_t at(int y, int x) const {
    return static_cast<std::size_t>(y) * static_cast<std::size_t>(size.width) + static_cast<std::size_t>(x);
  }
};

/// One view with all three outputs.
Picture draw(render::Renderer& renderer, const Pose& T_world_camera, const render::Camera& camera);

/// World-space ray of a pixel centre, scaled so that depth times it is the hit: the reference for every projection.
Eigen::Vector3d pixel_ray(const Pose& T_world_camera, const render::Camera& camera, double x, double y);

Pose look(const Eigen::Vector3d& position, double yaw, double pitch);

}  // namespace wiw::testing
