// SPDX-License-Identifier: Apache-2.0
#include <doctest/doctest.h>

#include <cmath>

#include "render/furnished.hpp"
#include "render/scenes.hpp"
#include "wiw/render/bulge.hpp"
#include "wiw/render/cpu/cpu_renderer.hpp"
#include "wiw/render/gpu/sun_map.hpp"
#include "wiw/render/shading.hpp"

using namespace wiw;
using namespace wiw::render;
using namespace wiw::testing;

namespace {

const Camera kView{Projection::kPerspective, {150, 203}, radians(90)};
const Pose kPose = look({0, 1.2, 0}, 0.4, -0.3);

scene::ScenePtr lone_sphere(int rings, const scene::Sun& sun) {
  SceneBuilder builder;
  builder.add_instance(make_sphere(1.f, rings));
  builder.scene.sun = sun;
  return builder.build();
}

}  // namespace

TEST_CASE("the facets of a ball do not shadow each other, however coarse it is and wherever the sun stands") {
  const Camera camera{Projection::kPerspective, {160, 160}, radians(50)};
  const Pose pose = look({0, 0, 3}, 0, 0);
  for (const int rings : {12, 24, 60}) {
    for (const Eigen::Vector3f& direction : {Eigen::Vector3f(1, 0.3f, 0.1f), Eigen::Vector3f(0.2f, 1, -0.4f)}) {
      const scene::Sun sun{direction.normalized(), 0.5f, 0.5f};
      const scene::ScenePtr scene = lone_sphere(rings, sun);
      const Picture picture = draw(*make_cpu_renderer(scene, {}), pose, camera);
      std::size_t seen = 0;
      for (int y = 0; y < camera.size.height; ++y) {
        for (int x = 0; x < camera.size.width; ++x) {
          const std::size_t i = picture.at(y, x);
          if (picture.instance[i] == 0) continue;
          const Eigen::Vector3d point = pose.translation() + picture.depth[i] * pixel_ray(pose, camera, x, y);
          const Eigen::Vector3d n = point.normalized();  // of the ball; interpolated ones are close
          const double cosine = n.dot(sun.direction.cast<double>());
          const double ambient = render::shading::ambient_light(n.x(), n.y(), n.z());
          const double light = render::shading::sun_light(ambient, cosine, 1.0, 0.5f, 0.5f);
          REQUIRE(std::abs(picture.color[3 * i] - 255 * light) < 5);
          ++seen;
        }
      }
      CHECK(seen > 5000);
    }
  }
}

TEST_CASE("a bulge is the depth below tangent planes: none where flat, hollow or smoothed over an edge") {
  using V = Eigen::Vector3f;
  const std::array<V, 3> corners{V(0, 0, 0), V(2, 0, 0), V(0, 2, 0)};
  const auto bent = [&](float tilt) {
    return std::array<V, 3>{V(-tilt, 0, 1).normalized(), V(tilt, 0, 1).normalized(), V(-tilt, 0, 1).normalized()};
  };
  CHECK(triangle_bulge(corners, bent(0.f)) == 0.f);
  CHECK(triangle_bulge(corners, bent(0.2f)) == doctest::Approx(2 * std::sin(std::atan(0.2))));
  CHECK(triangle_bulge(corners, bent(-0.2f)) == 0.f);
  CHECK(triangle_bulge(corners, bent(1.f)) == 0.f);
  CHECK(triangle_bulge({corners[0], corners[1], corners[1]}, bent(0.2f)) == 0.f);
}

TEST_CASE("moved instances take their shadows along") {
  const scene::ScenePtr scene = make_sunny();
  const std::uint32_t id = kFurnishedSphere;
  const Eigen::Affine3f moved = Eigen::Translation3f(0.1f, 0.9f, -1.3f) * Eigen::Scaling(0.7f);
  scene::Scene changed = *scene;
  changed.instances[id - 1].T_world_instance = moved;
  const auto renderer = make_cpu_renderer(scene, {.samples = 4});
  const Picture before = draw(*renderer, kPose, kView);
  renderer->set_poses(std::span(&id, 1), std::span(&moved, 1));
  const Picture after = draw(*renderer, kPose, kView);
  CHECK(after.color ==
        draw(*make_cpu_renderer(std::make_shared<const scene::Scene>(changed), {.samples = 4}), kPose, kView).color);
  std::size_t floor = 0;  // pixels of the floor that changed their light
  for (std::size_t i = 0; i < before.instance.size(); ++i) {
    floor += before.instance[i] == 1 && after.instance[i] == 1 && before.color[3 * i] != after.color[3 * i];
  }
  CHECK(floor > 100);
}

TEST_CASE("lightmaps and emissive surfaces have their light already") {
  scene::Scene scene = *make_furnished();
  const Picture before = draw(*make_cpu_renderer(std::make_shared<const scene::Scene>(scene), {}), kPose, kView);
  scene.sun = {Eigen::Vector3f(0.48f, 0.8f, 0.36f), 0.7f, 0.5f};
  const Picture after = draw(*make_cpu_renderer(std::make_shared<const scene::Scene>(scene), {}), kPose, kView);
  CHECK(after.depth == before.depth);
  CHECK(after.instance == before.instance);
  std::size_t lit = 0;
  for (std::size_t i = 0; i < before.instance.size(); ++i) {
    const bool has_light = before.instance[i] == 1 || before.instance[i] == 3 || before.instance[i] == 7;
    for (std::size_t c = 3 * i; has_light && c < 3 * i + 3; ++c) REQUIRE(after.color[c] == before.color[c]);
    lit += !has_light && before.instance[i] != 0 && after.color[3 * i] != before.color[3 * i];
  }
  CHECK(lit > 1000);
}

TEST_CASE("the squares of the sun's map hold the whole scene, and its small instances more finely") {
  SceneBuilder builder;
  builder.add_instance(make_quad({-5, 0, 5}, {10, 0, 0}, {0, 0, -10}));
  builder.add_instance(make_sphere(0.5f, 12));
  builder.add_instance(make_box({1, 0, 1}, {1.5f, 2, 1.5f}));
  const scene::ScenePtr scene = builder.build();
  const render::gpu::SceneGeometry geometry = render::gpu::build_geometry(*scene);
  std::vector<Eigen::Affine3f> poses(3, Eigen::Affine3f::Identity());
  poses[1] = Eigen::Translation3f(-0.7f, 0.4f, 1.2f) * Eigen::Scaling(0.8f);
  const render::gpu::SunBlock block = render::gpu::sun_block({}, *scene, geometry.meshes, poses, 512);
  CHECK(block.grid[1].head<2>().prod() < 0.2f * block.grid[0].head<2>().prod());
  for (std::size_t square = 0; square < render::gpu::kSunSquares; ++square) {
    const render::gpu::ViewBlock view = render::gpu::sun_view(block, square);
    for (std::size_t i = square; i < poses.size(); ++i) {
      for (const auto& position : scene->meshes[scene->instances[i].meshes[0]].positions) {
        const Eigen::Vector3f point = poses[i] * position;
        const Eigen::Vector3f from_corner = point - block.corner[square].head<3>();
        const float texel = block.right.head<3>().dot(from_corner) / block.grid[square][0];
        REQUIRE(texel >= 1.9f);
        REQUIRE(texel <= 510.1f);
        const Eigen::Vector3f offset = point - view.eye.head<3>();
        REQUIRE(std::abs(view.up.head<3>().dot(offset) * view.projection[1]) < 1.f);
        const float height = view.back.head<3>().dot(offset) * view.lens[0];
        REQUIRE(height > 0.f);
        REQUIRE(height < 1.f);
        // A point's texel by the drawing is that by the lookup.
        const float drawn = (view.right.head<3>().dot(offset) * view.projection[0] + 1) * 256;
        REQUIRE(std::abs(drawn - texel) < 0.01f);
      }
    }
  }
}
