// SPDX-License-Identifier: Apache-2.0
#include <doctest/doctest.h>

#include <limits>

#include "nav/rooms.hpp"
#include "wiw/core/error.hpp"
#include "wiw/nav/nav_mesh.hpp"
#include "wiw/nav/waypoints.hpp"

using namespace wiw;
using namespace wiw::nav;
using Eigen::Vector3f;

namespace {

std::shared_ptr<NavMesh> mesh_of(const test::Soup& soup) {
  return NavMesh::from_triangles(soup.vertices, soup.triangles);
}

test::Soup two_rooms() {
  test::Soup soup;
  soup.floor(0, 0, 10, 4);
  soup.block(4, 0, 5, 4);
  return soup;
}

}  // namespace

TEST_CASE("a floor is walkable up to the agent's radius from its edge") {
  test::Soup soup;
  soup.floor(0, 0, 6, 4);
  const auto mesh = mesh_of(soup);
  // Recast removes the cells at the drop, then erodes by two cells: a border of 0.1 to 0.2 m.
  CHECK(mesh->area() < 5.8 * 3.8 + 1e-6);
  CHECK(mesh->area() > 5.6 * 3.6 - 1e-6);
  CHECK(mesh->surface().islands.size() == 1);
  CHECK(mesh->is_navigable({3, 0, 2}));
  CHECK(!mesh->is_navigable({0.02f, 0, 2}));
  CHECK(!mesh->is_navigable({3, 1, 2}));
  CHECK(!mesh->is_navigable({1e30f, 0, 2}));
  CHECK(!mesh->snap({3, 0, std::nanf("")}));
  CHECK(std::abs((*mesh->snap({3, 0.5f, 2})).x() - 3) < 1e-5f);
}

TEST_CASE("a wall makes two islands and stops every step through it") {
  const auto mesh = mesh_of(two_rooms());
  REQUIRE(mesh->surface().islands.size() >= 2);
  CHECK(mesh->surface().islands[0].area >= mesh->surface().islands[1].area);
  const Vector3f left(1, 0, 2), right(9, 0, 2);
  CHECK(mesh->island_of(left) != mesh->island_of(right));
  CHECK(mesh->try_step(left, right) == left);
  const Distance distance = mesh->geodesic_distance(left, right, Metric::kDetour);
  CHECK(std::isinf(distance.metres));
  CHECK(distance.reason == NoPathReason::kOtherIsland);
  CHECK(mesh->geodesic_distance(left, {50, 0, 0}, Metric::kDetour).reason == NoPathReason::kEndOffMesh);
}

TEST_CASE("steps slide along walls or stop at them") {
  test::Soup soup;
  soup.floor(0, 0, 10, 10);
  soup.block(4, 4, 6, 6);
  const auto mesh = mesh_of(soup);
  const Vector3f start(3.5f, 0.2f, 5), end(4.5f, 0.2f, 5.5f);
  const Vector3f slid = mesh->try_step(start, end, true);
  const Vector3f stopped = mesh->try_step(start, end, false);
  CHECK(mesh->is_navigable(slid));
  CHECK(mesh->is_navigable(stopped));
  CHECK(slid.x() == doctest::Approx(stopped.x()).epsilon(0.01));
  CHECK(slid.z() == doctest::Approx(5.5).epsilon(0.01));
  CHECK(stopped.z() == doctest::Approx(5 + 0.5f * (stopped.x() - start.x())).epsilon(0.01));
  const Vector3f free = mesh->try_step({1, 0.2f, 1}, {2, 0.2f, 1.5f});
  CHECK((free - Vector3f(2, free.y(), 1.5f)).norm() < 1e-5f);
}

TEST_CASE("samples lie on the island asked for, and depend on the seed alone") {
  const auto mesh = mesh_of(two_rooms());
  for (const int island : {0, 1}) {
    for (const Vector3f& point : mesh->sample(200, 7, island)) {
      CHECK(mesh->island_of(point) == island);
      CHECK(mesh->is_navigable(point));
    }
  }
  CHECK(mesh->sample(5, 3) == mesh->sample(5, 3));
  CHECK(mesh->sample(5, 3) != mesh->sample(5, 4));
  CHECK_THROWS_AS((void)mesh->sample(1, 0, 99), ArgumentError);
}

TEST_CASE("a body of more cells than Recast counts is refused, not wrapped") {
  test::Soup soup;
  soup.floor(0, 0, 30, 30);
  const auto build = [&](const NavMeshSettings& settings) {
    return NavMesh::from_triangles(soup.vertices, soup.triangles, settings);
  };
  NavMeshSettings wide;
  wide.agent_radius = 6.3f;  // 126 cells
  CHECK(build(wide)->area() < 17.4 * 17.4 + 1e-3);
  wide.agent_radius = 6.4f;
  CHECK_THROWS_WITH_AS(build(wide), doctest::Contains("raise cell_size"), ArgumentError);
  NavMeshSettings fine;
  fine.cell_height = 0.007f;  // 215 cells, and 28 to climb
  CHECK(build(fine)->area() > 29 * 29);
  fine.cell_height = 0.006f;
  CHECK_THROWS_WITH_AS(build(fine), doctest::Contains("raise cell_height"), ArgumentError);
}

TEST_CASE("what is no number has no length and chooses no waypoints") {
  constexpr float kNaN = std::numeric_limits<float>::quiet_NaN();
  const auto mesh = mesh_of(two_rooms());
  const std::vector<Vector3f> points{{1, 0, 1}, {kNaN, 0, 1}};
  CHECK_THROWS_AS((void)mesh->surface_length(points), ArgumentError);
  CHECK_THROWS_AS(select_waypoints(*mesh, 0, {.min_samples = 10, .mean_weight = kNaN}), ArgumentError);
  CHECK_THROWS_AS(select_waypoints(*mesh, 0, {.min_samples = 10, .spacing = kNaN}), ArgumentError);
  for (const double density : {-1.0, 1e300, static_cast<double>(kNaN)}) {
    CHECK_THROWS_AS(select_waypoints(*mesh, 0, {.density = density, .min_samples = 10}), ArgumentError);
  }
  CHECK(!select_waypoints(*mesh, 0, {.density = 0, .min_samples = 10}).empty());
}

TEST_CASE("scenes with nothing to stand on, or too large, are refused") {
  test::Soup wall;
  wall.quad({0, 0, 0}, {0, 3, 0}, {5, 3, 0}, {5, 0, 0});
  CHECK_THROWS_AS(mesh_of(wall), ArgumentError);
  CHECK_THROWS_AS(mesh_of({}), ArgumentError);
  test::Soup plain;
  plain.floor(0, 0, 1e5, 1e5);
  CHECK_THROWS_AS(mesh_of(plain), ArgumentError);
  test::Soup broken;
  broken.floor(0, 0, 1, 1);
  broken.triangles[0][1] = 77;
  CHECK_THROWS_AS(mesh_of(broken), ArgumentError);
}
