// SPDX-License-Identifier: Apache-2.0
#include "render/scenes.hpp"

#include <cmath>

namespace wiw::testing {

using Vector = Eigen::Vector3f;
using Triangle = Eigen::Matrix<std::uint32_t, 3, 1>;

SceneBuilder::SceneBuilder() { scene.name = "test"; }

std::int32_t SceneBuilder::add_texture(Size size, const std::vector<std::uint8_t>& rgba) {
  scene.textures.push_back({"texture " + std::to_string(scene.textures.size()), size, rgba});
  return static_cast<std::int32_t>(scene.textures.size()) - 1;
}

std::int32_t SceneBuilder::add_material(const scene::Material& material) {
  scene.materials.push_back(material);
  return static_cast<std::int32_t>(scene.materials.size()) - 1;
}

std::uint32_t SceneBuilder::add_instance(scene::Mesh mesh, const Eigen::Affine3f& T_world_instance) {
  scene::Instance instance;
  instance.id = static_cast<std::uint32_t>(scene.instances.size()) + 1;
  instance.name = "instance " + std::to_string(instance.id);
  instance.meshes = {static_cast<std::uint32_t>(scene.meshes.size())};
  instance.T_world_instance = T_world_instance;
  scene.meshes.push_back(std::move(mesh));
  scene.instances.push_back(instance);
  return instance.id;
}

scene::ScenePtr SceneBuilder::build() const { return std::make_shared<const scene::Scene>(scene); }

namespace {

struct Quads {
  std::vector<Vector> positions;
  std::vector<Eigen::Vector2f> uv;
  std::vector<Triangle> triangles;

  void add(const Vector& corner, const Vector& across, const Vector& along) {
    const auto base = static_cast<std::uint32_t>(positions.size());
    for (const auto& [s, t] : {std::pair{0.f, 0.f}, {1.f, 0.f}, {1.f, 1.f}, {0.f, 1.f}}) {
      positions.emplace_back(corner + s * across + t * along);
      uv.emplace_back(s, t);
    }
    triangles.emplace_back(base, base + 1, base + 2);
    triangles.emplace_back(base, base + 2, base + 3);
  }
};

}  // namespace

scene::Mesh make_quad(const Vector& corner, const Vector& across, const Vector& along, float repeats) {
  Quads quads;
  quads.add(corner, across, along);
  scene::Mesh mesh;
  mesh.positions = quads.positions;
  mesh.lightmap_uv = quads.uv;
  for (auto& uv : quads.uv) uv *= repeats;
  mesh.uv = quads.uv;
  mesh.triangles = quads.triangles;
  return mesh;
}

scene::Mesh make_box(const Vector& low, const Vector& high) {
  const Vector x((high - low).x(), 0, 0);
  const Vector y(0, (high - low).y(), 0);
  const Vector z(0, 0, (high - low).z());
  Quads quads;
  quads.add(low, y, z);
  quads.add(low + x, z, y);
  quads.add(low, z, x);
  quads.add(low + y, x, z);
  quads.add(low, x, y);
  quads.add(low + z, y, x);
  scene::Mesh mesh;
  mesh.positions = quads.positions;
  mesh.uv = quads.uv;
  mesh.triangles = quads.triangles;
  return mesh;
}

scene::Mesh make_sphere(float radius, int rings) {
  std::vector<Vector> normals;
  std::vector<Triangle> triangles;
  const int columns = 2 * rings;
  for (int i = 0; i <= rings; ++i) {
    for (int j = 0; j <= columns; ++j) {
      const double latitude = kPi * (0.5 - static_cast<double>(i) / rings);
      const double longitude = kPi * j / rings;
      normals.emplace_back(Eigen::Vector3d(std::cos(latitude) * std::sin(longitude), std::sin(latitude),
                                           std::cos(latitude) * std::cos(longitude))
                               .cast<float>());
      if (i == rings || j == columns) continue;
      const auto a = static_cast<std::uint32_t>(i * (columns + 1) + j);
      const auto below = a + static_cast<std::uint32_t>(columns) + 1;
      if (i > 0) triangles.emplace_back(a, below, a + 1);
      if (i + 1 < rings) triangles.emplace_back(a + 1, below, below + 1);
    }
  }
  scene::Mesh mesh;
  std::vector<Vector> positions = normals;
  for (auto& position : positions) position *= radius;
  mesh.positions = positions;
  mesh.normals = normals;
  mesh.triangles = triangles;
  return mesh;
}

scene::ScenePtr make_room(const Vector& low, const Vector& high) {
  const Vector x((high - low).x(), 0, 0);
  const Vector y(0, (high - low).y(), 0);
  const Vector z(0, 0, (high - low).z());
  SceneBuilder builder;
  builder.add_instance(make_quad(low, y, z));
  builder.add_instance(make_quad(low + x, y, z));
  builder.add_instance(make_quad(low, x, z));
  builder.add_instance(make_quad(low + y, x, z));
  builder.add_instance(make_quad(low, x, y));
  builder.add_instance(make_quad(low + z, x, y));
  return builder.build();
}

std::vector<std::uint8_t> checkerboard(int side, int cells) {
  std::vector<std::uint8_t> rgba;
  for (int y = 0; y < side; ++y) {
    for (int x = 0; x < side; ++x) {
      const auto value = static_cast<std::uint8_t>((x * cells / side + y * cells / side) % 2 == 0 ? 230 : 20);
      rgba.insert(rgba.end(), {value, value, value, 255});
    }
  }
  return rgba;
}

Picture draw(render::Renderer& renderer, const Pose& T_world_camera, const render::Camera& camera) {
  Picture picture;
  picture.size = camera.size;
  picture.color.assign(3 * camera.size.pixels(), 7);
  picture.depth.assign(camera.size.pixels(), -7.f);
  picture.instance.assign(camera.size.pixels(), 7777);
  renderer.render(std::span(&T_world_camera, 1), camera,
                  {picture.color.data(), picture.depth.data(), picture.instance.data()});
  return picture;
}

Eigen::Vector3d pixel_ray(const Pose& T_world_camera, const render::Camera& camera, double x, double y) {
  Eigen::Vector3d ray;
  if (camera.projection == render::Projection::kPerspective) {
    const double f = Intrinsics{camera.size, camera.hfov}.focal();
    ray = {(x + 0.5 - camera.size.width / 2.0) / f, -(y + 0.5 - camera.size.height / 2.0) / f, -1.0};
  } else {
    const double longitude = ((x + 0.5) / camera.size.width - 0.5) * 2.0 * kPi;
    const double latitude = (0.5 - (y + 0.5) / camera.size.height) * kPi;
    ray = {std::sin(longitude) * std::cos(latitude), std::sin(latitude), -std::cos(longitude) * std::cos(latitude)};
  }
  return T_world_camera.linear() * ray;
}

Pose look(const Eigen::Vector3d& position, double yaw, double pitch) {
  Pose pose = pose_from_yaw(position, yaw);
  pose.rotate(Eigen::AngleAxisd(pitch, Eigen::Vector3d::UnitX()));
  return pose;
}

}  // namespace wiw::testing
