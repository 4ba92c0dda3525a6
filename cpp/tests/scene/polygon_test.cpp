// SPDX-License-Identifier: Apache-2.0
#include "wiw/scene/import/polygon.hpp"

#include <doctest/doctest.h>

#include <Eigen/Geometry>
#include <cmath>
#include <numbers>
#include <numeric>

#include "wiw/core/rng.hpp"
#include "wiw/scene/import/weld.hpp"

namespace {

Eigen::Vector3f area_vector(const wiw::scene::Triangle& t, const std::vector<Eigen::Vector3f>& p) {
  return 0.5f * (p[t[1]] - p[t[0]]).cross(p[t[2]] - p[t[0]]);
}

}  // namespace

TEST_CASE("polygons of any shape are cut into triangles that cover them once and face the same way") {
  for (std::uint64_t key = 0; key < 200; ++key) {
    wiw::Rng rng(wiw::fold_key({key}));
    const auto corners = static_cast<unsigned>(3 + rng.uniform() * 12);
    const Eigen::Quaternionf turn = Eigen::Quaternionf(Eigen::Vector4f::NullaryExpr([&] {
                                      return static_cast<float>(rng.uniform() - 0.5);
                                    })).normalized();
    // A star-shaped polygon is simple, and its area is the sum over its spokes; most of these are not convex.
    std::vector<Eigen::Vector3f> positions;
    Eigen::Vector3f expected = Eigen::Vector3f::Zero();
    for (unsigned i = 0; i < corners; ++i) {
      const double angle = 2. * std::numbers::pi * i / corners;
      const double radius = 0.2 + rng.uniform();
      positions.emplace_back(turn *
                             Eigen::Vector3d(radius * std::cos(angle), radius * std::sin(angle), 0.).cast<float>());
    }
    for (unsigned i = 0; i < corners; ++i) expected += 0.5f * positions[i].cross(positions[(i + 1) % corners]);
    std::vector<unsigned> polygon(corners);
    std::iota(polygon.begin(), polygon.end(), 0U);

    std::vector<wiw::scene::Triangle> triangles;
    wiw::scene::triangulate(polygon, positions, triangles);
    CHECK(triangles.size() == corners - 2);
    float area = 0.f;
    for (const wiw::scene::Triangle& triangle : triangles) {
      CHECK(area_vector(triangle, positions).dot(expected) > 0.f);
      area += area_vector(triangle, positions).norm();
    }
    CHECK(area == doctest::Approx(expected.norm()).epsilon(1e-4));  // no overlap: the areas add up
  }
}

TEST_CASE("what has no area gives no triangles") {
  const std::vector<Eigen::Vector3f> line{{0, 0, 0}, {1, 0, 0}, {2, 0, 0}, {3, 0, 0}};
  const unsigned polygon[] = {0, 1, 2, 3};
  for (const std::size_t corners : {0U, 1U, 2U, 3U, 4U}) {
    std::vector<wiw::scene::Triangle> triangles;
    wiw::scene::triangulate({polygon, corners}, line, triangles);
    CHECK(triangles.empty());
  }
}

TEST_CASE("welding merges equal vertices only") {
  wiw::scene::Mesh mesh;
  mesh.positions =
      std::vector<Eigen::Vector3f>{{0, 0, 0}, {1, 0, 0}, {0, 1, 0}, {-0.f, 0, 0}, {1, 0, 0}, {5, 5, 5}, {0, 0, 1}};
  mesh.uv = std::vector<Eigen::Vector2f>{{0, 0}, {1, 0}, {0, 1}, {0, 0}, {0.5f, 0}, {9, 9}, {0, 0}};
  mesh.triangles = std::vector<wiw::scene::Triangle>{{0, 1, 2}, {3, 4, 6}};
  const wiw::scene::Mesh welded = wiw::scene::weld(mesh);
  CHECK(welded.positions.size() == 5);  // 0 and 3 are one, 1 and 4 differ in uv, 5 is not used
  for (std::size_t t = 0; t < 2; ++t) {
    for (int corner = 0; corner < 3; ++corner) {
      const auto before = mesh.triangles[t][corner];
      const auto after = welded.triangles[t][corner];
      CHECK(welded.positions[after] == mesh.positions[before]);
      CHECK(welded.uv[after] == mesh.uv[before]);
    }
  }
}
