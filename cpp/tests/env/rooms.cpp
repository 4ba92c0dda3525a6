// SPDX-License-Identifier: Apache-2.0
#include "env/rooms.hpp"

#include "nav/rooms.hpp"
#include "render/scenes.hpp"

namespace wiw::testing {

env::NavigationWorld make_world(float shade) {
  test::Soup soup;
  soup.floor(0, 0, 6, 4);
  soup.block(2.5f, 2, 3.5f, 4);
  SceneBuilder builder;
  const auto add = [&](const Eigen::Vector3f& low, const Eigen::Vector3f& high, const Eigen::Vector3f& color) {
    scene::Mesh mesh = make_box(low, high);
    mesh.material = builder.add_material({.base_color = {color.x(), color.y(), color.z(), 1}});
    builder.add_instance(std::move(mesh));
  };
  add({0, -0.1f, 0}, {6, 0, 4}, {shade, shade, shade});
  add({2.5f, 0, 2}, {3.5f, 1.2f, 4}, {0.9f, 0.2f, shade});
  add({-0.1f, 0, 0}, {0, 2.5f, 4}, {shade, 0.7f, 0.2f});
  add({0, 0, -0.1f}, {6, 2.5f, 0}, {0.2f, shade, 0.8f});
  const scene::ScenePtr scene = builder.build();
  return {render::make_renderer(scene, render::Backend::kCpu),
          nav::NavMesh::from_triangles(soup.vertices, soup.triangles), std::make_shared<nav::Ground>(*scene)};
}

env::NavigationConfig small_pictures(env::Motion motion) {
  env::NavigationConfig config;
  config.motion = motion;
  config.panorama = {32, 64};
  config.front = {24, 24};
  return config;
}

Pictures::Pictures(const env::NavigationConfig& config, std::size_t count)
    : panorama(3 * config.panorama.pixels() * count, 7),
      front(3 * config.front.pixels() * count, 7),
      depth(config.panorama.pixels() * count, -7.f) {}

env::ObservationTargets Pictures::targets() { return {panorama.data(), front.data(), depth.data()}; }

}  // namespace wiw::testing
