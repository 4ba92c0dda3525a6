// SPDX-License-Identifier: Apache-2.0
#include "render/furnished.hpp"

#include <cmath>

#include "render/scenes.hpp"

namespace wiw::testing {

namespace {

/// Smooth blobs of colour, so that filtering matters and no pixel sits on a hard edge.
std::vector<std::uint8_t> blobs(Size size, std::uint8_t alpha_outside) {
  std::vector<std::uint8_t> rgba;
  for (int y = 0; y < size.height; ++y) {
    for (int x = 0; x < size.width; ++x) {
      const double u = 2 * kPi * x / size.width;
      const double v = 2 * kPi * y / size.height;
      const double wave = std::sin(3 * u) * std::cos(4 * v);
      rgba.push_back(static_cast<std::uint8_t>(140 + 80 * wave));
      rgba.push_back(static_cast<std::uint8_t>(130 + 70 * std::sin(5 * u + v)));
      rgba.push_back(static_cast<std::uint8_t>(120 + 60 * std::cos(2 * u - 3 * v)));
      rgba.push_back(wave > 0 ? 255 : alpha_outside);
    }
  }
  return rgba;
}

scene::Mesh with(scene::Mesh mesh, std::int32_t material, std::int32_t lightmap = scene::kNone) {
  mesh.material = material;
  mesh.lightmap = lightmap;
  return mesh;
}

scene::Mesh colored_box() {
  scene::Mesh mesh = make_box({-0.3f, 0.f, -0.3f}, {0.3f, 0.7f, 0.3f});
  std::vector<Eigen::Matrix<std::uint8_t, 4, 1>> colors;
  for (std::size_t i = 0; i < mesh.positions.size(); ++i) {
    colors.emplace_back(static_cast<std::uint8_t>(60 + 40 * (i % 4)), static_cast<std::uint8_t>(250 - 9 * i),
                        static_cast<std::uint8_t>(10 * i), std::uint8_t{255});
  }
  mesh.colors = colors;
  return mesh;
}

}  // namespace

scene::ScenePtr make_furnished() {
  SceneBuilder builder;
  const std::int32_t smooth = builder.add_texture({48, 65}, blobs({48, 65}, 255));
  const std::int32_t checks = builder.add_texture({128, 128}, checkerboard(128, 16));
  const std::int32_t light = builder.add_texture({32, 32}, blobs({32, 32}, 255));
  const std::int32_t holes = builder.add_texture({64, 64}, blobs({64, 64}, 0));
  const std::int32_t wall = builder.add_material({"wall", {0.9f, 0.8f, 1.f, 1.f}, smooth});
  const std::int32_t floor = builder.add_material({"floor", {1.f, 1.f, 1.f, 1.f}, checks});
  const std::int32_t panel = builder.add_material({"panel", {1.f, 0.9f, 0.4f, 1.f}, smooth, -1.f, true});
  const std::int32_t screen = builder.add_material({"screen", {0.7f, 1.f, 0.7f, 1.f}, holes, 0.5f});
  const std::int32_t paint = builder.add_material({"paint", {0.3f, 0.5f, 0.9f, 1.f}});

  builder.add_instance(with(make_quad({-3, 0, 3}, {6, 0, 0}, {0, 0, -6}, 4.f), floor, light));
  builder.add_instance(with(make_quad({-3, 0, -3}, {6, 0, 0}, {0, 2.5f, 0}, 2.f), wall));
  builder.add_instance(with(make_quad({-3, 0, 3}, {0, 0, -6}, {0, 2.5f, 0}, 2.f), wall, light));
  builder.add_instance(with(make_quad({3, 0, -3}, {0, 0, 6}, {0, 2.5f, 0}, 1.f), wall));
  builder.add_instance(colored_box(), Eigen::Affine3f(Eigen::Translation3f(-1.f, 0.f, -1.5f) *
                                                      Eigen::AngleAxisf(0.5f, Eigen::Vector3f::UnitY())));
  builder.add_instance(with(make_sphere(0.5f, 80), paint), Eigen::Affine3f(Eigen::Translation3f(0.8f, 0.6f, -1.8f)));
  builder.add_instance(with(make_quad({-0.5f, 1.6f, -2.95f}, {1, 0, 0}, {0, 0.5f, 0}), panel));
  builder.add_instance(with(make_quad({1.0f, 0.2f, 2.0f}, {1, 0, 0.3f}, {0, 1.5f, 0}), screen));
  builder.add_instance(with(make_box({0, 0, 0}, {1, 1, 1}), wall),
                       Eigen::Affine3f(Eigen::Translation3f(-2.5f, 0.f, 1.f) * Eigen::Scaling(0.4f, 1.4f, 0.8f)));
  return builder.build();
}

scene::ScenePtr make_tiled() {
  using scene::Wrap;
  SceneBuilder builder;
  const Eigen::Vector2f begin(-1.3f, -0.6f);
  constexpr Wrap kWraps[] = {Wrap::kRepeat, Wrap::kClamp, Wrap::kMirror};
  for (int i = 0; i < 6; ++i) {
    const bool nearest = i >= 3;
    const Size size = nearest ? Size{4, 5} : Size{24, 31};
    const std::int32_t texture = builder.add_texture(size, blobs(size, nearest ? 0 : 255));
    builder.scene.textures.back().sampling = {kWraps[i % 3], kWraps[(i + 1) % 3], nearest};
    const std::int32_t material =
        builder.add_material({"tile", Eigen::Vector4f::Ones(), texture, i == 5 ? 0.5f : -1.f, true});
    scene::Mesh mesh =
        make_quad({-1.5f + static_cast<float>(i % 3), static_cast<float>(i / 3), -1}, {0.95f, 0, 0}, {0, 0.95f, -0.3f});
    std::vector<Eigen::Vector2f> uv(mesh.uv.begin(), mesh.uv.end());
    for (Eigen::Vector2f& each : uv) each = begin + 3.7f * each;
    mesh.uv = uv;
    builder.add_instance(with(mesh, material));
  }
  return builder.build();
}

scene::ScenePtr make_sunny() {
  scene::Scene scene = *make_furnished();
  scene.sun = {Eigen::Vector3f(0.48f, 0.8f, 0.36f), 0.7f, 0.5f};
  // The floor's light is the sun's as well, or it would show no shadows.
  scene.meshes[0].lightmap = scene::kNone;
  return std::make_shared<const scene::Scene>(scene);
}

}  // namespace wiw::testing
