// SPDX-License-Identifier: Apache-2.0
#include "wiw/nav/ground.hpp"

#include <doctest/doctest.h>
#include <sys/resource.h>

#include <cmath>
#include <limits>
#include <random>

using namespace wiw;
using Eigen::Vector3d;
using Eigen::Vector3f;

namespace {

void add_quad(scene::TriangleSoup& soup, const Vector3f& a, const Vector3f& b, const Vector3f& c, const Vector3f& d) {
  const auto base = static_cast<std::uint32_t>(soup.vertices.size());
  soup.vertices.insert(soup.vertices.end(), {a, b, c, d});
  soup.triangles.insert(soup.triangles.end(), {{base, base + 1, base + 2}, {base, base + 2, base + 3}});
}

/// A floor at `height` over [0, 4] x [0, 4], a rug of 1 cm over [1, 2] x [1, 2], a table top 0.7 m above.
scene::TriangleSoup room(float height) {
  scene::TriangleSoup soup;
  add_quad(soup, {0, height, 0}, {0, height, 4}, {4, height, 4}, {4, height, 0});
  add_quad(soup, {1, height + 0.01f, 1}, {1, height + 0.01f, 2}, {2, height + 0.01f, 2}, {2, height + 0.01f, 1});
  add_quad(soup, {0, height + 0.7f, 0}, {0, height + 0.7f, 4}, {4, height + 0.7f, 4}, {4, height + 0.7f, 0});
  add_quad(soup, {3, height, 0}, {3, height + 2, 0}, {3, height + 2, 4}, {3, height, 4});  // a wall
  return soup;
}

}  // namespace

TEST_CASE("the ground is the floor below a point that Recast has lifted") {
  for (const float height : {-3.f, 0.f, 0.05f, 1.f}) {
    const nav::Ground ground(room(height));
    for (const double lift : {0.0, 0.15, 0.2, 0.4}) {
      CHECK(ground.height({0.5, height + lift, 0.5}) == doctest::Approx(height).epsilon(1e-6));
      CHECK(ground.height({1.5, height + lift, 1.5}) == doctest::Approx(height + 0.01).epsilon(1e-6));
      CHECK(ground.height({3.0, height + lift, 2.0}) == doctest::Approx(height).epsilon(1e-6));  // the wall is no floor
    }
    CHECK(ground.height({0.5, height + 0.75, 0.5}) == doctest::Approx(height + 0.7).epsilon(1e-6));
    CHECK(ground.height({9, 5, 9}) == 5);  // nothing there
    CHECK(ground.height({0.5, height - 1, 0.5}) == height - 1);
  }
  CHECK(nav::Ground(scene::TriangleSoup{}).height({1, 2, 3}) == 2);
}

TEST_CASE("a point off the mesh, which snapping makes NaN, stays as it is") {
  const nav::Ground ground(room(0));
  constexpr double kNaN = std::numeric_limits<double>::quiet_NaN(), kInfinity = std::numeric_limits<double>::infinity();
  CHECK(ground.height({kNaN, 0.1, 1}) == 0.1);
  CHECK(ground.height({1, 0.1, kNaN}) == 0.1);
  CHECK(std::isnan(ground.height({0.5, kNaN, 0.5})));
  CHECK(ground.height({kInfinity, 0.1, -kInfinity}) == 0.1);
  CHECK(ground.height({1e30, 0.1, -1e30}) == 0.1);
}

TEST_CASE("a strip that is long beyond measure takes no more memory than a floor") {
  scene::TriangleSoup soup;
  add_quad(soup, {0, 0, 0}, {0, 0, 0.001f}, {4e9f, 0, 0.001f}, {4e9f, 0, 0});
  CHECK(nav::Ground(soup).height({5, 0.1, 0.0005}) == 0);
}

TEST_CASE("slivers take memory by their area, and no point falls between them") {
  scene::TriangleSoup soup;
  constexpr std::uint32_t kCorners = 4096;
  constexpr double kRadius = 250, kSlope = 0.1;
  for (std::uint32_t i = 0; i < kCorners; ++i) {
    const double angle = 2 * double(EIGEN_PI) * i / kCorners, x = kRadius * std::cos(angle),
                 z = kRadius * std::sin(angle);
    soup.vertices.emplace_back(float(x), float(kSlope * x), float(z));
    if (i >= 2) soup.triangles.push_back({0, i, i - 1});  // a fan, whose triangles are as long as the disc
  }
  const nav::Ground ground(soup);  // with each triangle in all cells around it: 10 GB
  std::mt19937 random(7);
  std::uniform_real_distribution<double> place(-170.0, 170.0);
  for (int i = 0; i < 3000; ++i) {
    const double x = place(random), z = place(random);
    CHECK(ground.height({x, kSlope * x + 0.05, z}) == doctest::Approx(kSlope * x).epsilon(1e-4));
  }
}

TEST_CASE("heights on a bumpy sheet are those of every triangle looked at") {
  std::mt19937 random(7);
  std::uniform_real_distribution<float> bump(0.f, 0.08f);
  scene::TriangleSoup soup;
  constexpr int kSide = 24;
  for (int z = 0; z <= kSide; ++z) {
    for (int x = 0; x <= kSide; ++x)
      soup.vertices.emplace_back(0.21f * float(x) - 2, bump(random), 0.21f * float(z) - 1);
  }
  for (std::uint32_t z = 0; z < kSide; ++z) {
    for (std::uint32_t x = 0; x < kSide; ++x) {
      const std::uint32_t a = z * (kSide + 1) + x, b = a + kSide + 1;
      soup.triangles.insert(soup.triangles.end(), {{a, b, b + 1}, {a, b + 1, a + 1}});
    }
  }
  const nav::Ground ground(soup);
  std::uniform_real_distribution<double> place(0.0, 0.21 * kSide);
  for (int i = 0; i < 300; ++i) {
    const Vector3d point(place(random) - 2, 0.2, place(random) - 1);
    double expected = -1;
    for (const auto& triangle : soup.triangles) {
      Eigen::Matrix3d corners;
      for (int k = 0; k < 3; ++k) corners.col(k) = soup.vertices[triangle[k]].cast<double>();
      Eigen::Matrix3d system = corners;
      system.row(1).setOnes();  // barycentric weights of (x, z)
      const Vector3d weights = system.fullPivLu().solve(Vector3d(point.x(), 1, point.z()));
      if (weights.minCoeff() > -1e-7) expected = std::max(expected, corners.row(1).dot(weights));
    }
    CHECK(ground.height(point) == doctest::Approx(expected).epsilon(1e-5));
  }
}

TEST_CASE("hundreds of floors above each other take memory by their number, and keep their heights") {
  scene::TriangleSoup soup;
  constexpr int kFloors = 600;
  for (int i = 0; i < kFloors; ++i) {
    const auto height = static_cast<float>(i);
    add_quad(soup, {0, height, 0}, {0, height, 500}, {500, height, 500}, {500, height, 0});
  }
  const auto peak = [] {
    rusage use{};
    getrusage(RUSAGE_SELF, &use);
    return use.ru_maxrss;  // kilobytes
  };
  const auto before = peak();
  const nav::Ground ground(soup);  // with each triangle in all cells of 0.25 m: 5 GB
  CHECK(peak() - before < 500'000);
  std::mt19937 random(7);
  std::uniform_real_distribution<double> place(0, 500);
  for (int i = 0; i < kFloors; i += 7) {
    CHECK(ground.height({place(random), i + 0.2, place(random)}) == doctest::Approx(i));
  }
}
