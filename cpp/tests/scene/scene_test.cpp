// SPDX-License-Identifier: Apache-2.0
#include "wiw/scene/scene.hpp"

#include <doctest/doctest.h>

#include <limits>

#include "wiw/core/error.hpp"

namespace {

wiw::scene::Scene one_triangle() {
  wiw::scene::Scene scene;
  wiw::scene::Mesh mesh;
  mesh.positions = std::vector<Eigen::Vector3f>{{0, 0, 0}, {1, 0, 0}, {0, 1, 0}};
  mesh.triangles = std::vector<Eigen::Matrix<std::uint32_t, 3, 1>>{{0, 1, 2}};
  scene.meshes = {mesh};
  scene.instances = {{1, "thing", wiw::scene::kNone, {0}}};
  return scene;
}

}  // namespace

TEST_CASE("an instance names meshes that are there, the greatest index included") {
  wiw::scene::Scene scene = one_triangle();
  CHECK_NOTHROW(scene.validate());
  for (const std::uint32_t mesh : {1U, 0x7FFFFFFFU, 0x80000000U, 0xFFFFFFFFU}) {
    scene.instances[0].meshes = {mesh};
    CHECK_THROWS_WITH_AS(scene.validate(), doctest::Contains(("'thing' is " + std::to_string(mesh)).c_str()),
                         wiw::ArgumentError);
  }
}

TEST_CASE("a pose is finite") {
  for (const float value : {std::numeric_limits<float>::infinity(), std::numeric_limits<float>::quiet_NaN()}) {
    wiw::scene::Scene scene = one_triangle();
    scene.instances[0].T_world_instance.translation().y() = value;
    CHECK_THROWS_WITH_AS(scene.validate(), doctest::Contains("the pose of 'thing' is not finite"), wiw::ArgumentError);
  }
}

TEST_CASE("a sun has a direction of length 1, and strengths in [0, 1]") {
  wiw::scene::Scene scene = one_triangle();
  scene.sun.emplace();
  CHECK_NOTHROW(scene.validate());
  constexpr float kNan = std::numeric_limits<float>::quiet_NaN();
  for (const Eigen::Vector3f& direction : {Eigen::Vector3f(0, 0, 0), Eigen::Vector3f(0, 2, 0), {0, kNan, 0}}) {
    scene.sun = {direction};
    CHECK_THROWS_WITH_AS(scene.validate(), doctest::Contains("direction must have length 1"), wiw::ArgumentError);
  }
  for (const float value : {-0.1f, 1.1f, kNan}) {
    scene.sun = {Eigen::Vector3f::UnitY(), value, 0.5f};
    CHECK_THROWS_WITH_AS(scene.validate(), doctest::Contains("strength must be in [0, 1]"), wiw::ArgumentError);
    scene.sun = {Eigen::Vector3f::UnitY(), 0.5f, value};
    CHECK_THROWS_WITH_AS(scene.validate(), doctest::Contains("ambient must be in [0, 1]"), wiw::ArgumentError);
  }
}

TEST_CASE("placements of a mesh sum to what 32 bits can number") {
  wiw::scene::Scene scene = one_triangle();
  auto& mesh = scene.meshes[0];
  mesh.positions = std::vector<Eigen::Vector3f>(1'000'000, Eigen::Vector3f::Zero());
  scene.instances[0].meshes.assign(1500, 0);
  CHECK_NOTHROW(scene.validate());
  scene.instances[0].meshes.assign(1501, 0);
  CHECK_THROWS_WITH_AS(scene.validate(), doctest::Contains("more than 1500000000 vertices"), wiw::ArgumentError);
  mesh.positions = std::vector<Eigen::Vector3f>(3, Eigen::Vector3f::Zero());
  mesh.triangles = std::vector<Eigen::Matrix<std::uint32_t, 3, 1>>(1'000'000, {0, 1, 2});
  scene.instances[0].meshes.assign(500, 0);
  CHECK_NOTHROW(scene.validate());
  scene.instances.push_back({2, "more", wiw::scene::kNone, {0}});
  CHECK_THROWS_WITH_AS(scene.validate(), doctest::Contains("more than 500000000 triangles"), wiw::ArgumentError);
}
