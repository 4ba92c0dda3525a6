// SPDX-License-Identifier: Apache-2.0
#include "wiw/physics/shape.hpp"

#include <doctest/doctest.h>

#include <cmath>
#include <random>

#include "wiw/core/error.hpp"
#include "wiw/core/rng.hpp"

using namespace wiw;
using namespace wiw::physics;
using Eigen::Matrix3d;
using Eigen::Vector3d;

namespace {

ConvexHull corners(const Vector3d& size, const Vector3d& center) {
  ConvexHull hull;
  for (int i = 0; i < 8; ++i) {
    const Vector3d corner(i & 1 ? 0.5 : -0.5, i & 2 ? 0.5 : -0.5, i & 4 ? 0.5 : -0.5);
    hull.points.emplace_back(center + corner.cwiseProduct(size));
  }
  return hull;
}

/// Mass properties by throwing points, the slow way.
MassProperties sampled(const Vector3d& bound, auto inside) {
  Rng random(3);
  std::uniform_real_distribution<double> unit(-1, 1);
  Vector3d sum = Vector3d::Zero();
  Matrix3d second = Matrix3d::Zero();
  int hits = 0;
  for (int i = 0; i < 400000; ++i) {
    const Vector3d p = bound.cwiseProduct(Vector3d(unit(random), unit(random), unit(random)));
    if (!inside(p)) continue;
    ++hits;
    sum += p;
    second += p * p.transpose();
  }
  second /= hits;
  const Vector3d center = sum / hits;
  second -= center * center.transpose();
  return {1, center, second.trace() * Matrix3d::Identity() - second};
}

}  // namespace

TEST_CASE("a hull of a box's corners has the box's mass properties, wherever it lies") {
  const Vector3d size(0.1, 0.2, 0.3), center(1, -2, 3);
  const std::vector<Part> box{{Box{size}}}, hull{{corners(size, center)}};
  const MassProperties a = mass_properties(box, 2), b = mass_properties(hull, 2);
  CHECK((b.center - center).norm() < 1e-9);
  CHECK((a.inertia - b.inertia).norm() < 1e-9);
  CHECK(a.inertia(0, 0) == doctest::Approx(2.0 / 12 * (0.04 + 0.09)));
}

TEST_CASE("capsules and compounds agree with points thrown into them") {
  const std::vector<Part> capsule{{Capsule{0.1, 0.3}}};
  const MassProperties exact = mass_properties(capsule, 1);
  const MassProperties thrown = sampled({0.1, 0.1, 0.25}, [](const Vector3d& p) {
    return (p - Vector3d(0, 0, std::clamp(p.z(), -0.15, 0.15))).norm() < 0.1;
  });
  CHECK((exact.inertia - thrown.inertia).norm() < 0.01 * exact.inertia.norm());

  Part arm{Cylinder{0.05, 0.4}};
  arm.pose.translate(Vector3d(0.2, 0, 0.1)).rotate(Eigen::AngleAxisd(1.0, Vector3d::UnitY()));
  const std::vector<Part> both{{Box{{0.2, 0.2, 0.1}}}, arm};
  const MassProperties sum = mass_properties(both, 1);
  const MassProperties points = sampled({0.5, 0.2, 0.4}, [&](const Vector3d& p) {
    const Vector3d q = arm.pose.inverse() * p;
    const bool in_arm = q.head<2>().norm() < 0.05 && std::abs(q.z()) < 0.2;
    const bool in_box = std::abs(p.x()) < 0.1 && std::abs(p.y()) < 0.1 && std::abs(p.z()) < 0.05;
    return in_arm || in_box;
  });
  // The overlap counts twice in the exact sum, so the comparison is a loose one.
  CHECK((sum.inertia - points.inertia).norm() < 0.15 * sum.inertia.norm());
}

TEST_CASE("principal axes give the inertia back") {
  Rng random(1);
  std::normal_distribution<double> normal;
  for (int i = 0; i < 50; ++i) {
    const Matrix3d root = Matrix3d::NullaryExpr([&] { return normal(random); });
    const MassProperties properties{1, Vector3d(1, 2, 3), root * root.transpose()};
    const PrincipalFrame frame = principal_frame(properties);
    const Matrix3d axes = frame.pose.linear();
    CHECK(axes.determinant() == doctest::Approx(1));
    CHECK((axes * frame.moments.asDiagonal() * axes.transpose() - properties.inertia).norm() < 1e-9);
  }
}

TEST_CASE("impossible shapes are refused") {
  const double nan = std::nan("");
  CHECK_THROWS_AS(check_part({Box{{0.1, 0, 0.1}}}, "x"), ArgumentError);
  CHECK_THROWS_AS(check_part({Sphere{-1}}, "x"), ArgumentError);
  CHECK_THROWS_AS(check_part({Cylinder{nan, 1}}, "x"), ArgumentError);
  CHECK_THROWS_WITH_AS(check_part({Cylinder{1e-200, 1}}, "x"),
                       "x: expected a radius of 1e-09 metres or more, got 1e-200", ArgumentError);
  CHECK_THROWS_AS(check_part({ConvexHull{{{0, 0, 0}, {1, 0, 0}, {0, 1, 0}, {1, 1, 0}}}}, "x"), ArgumentError);
  Part skewed{Sphere{1}};
  skewed.pose.matrix()(0, 1) = 1;
  CHECK_THROWS_AS(check_part(skewed, "x"), ArgumentError);
}

TEST_CASE("a rod is as solid as a plate; what only rounding makes thick is flat") {
  const Vector3d away(0.3, 0.2, -0.1);
  for (const Vector3d& size : {Vector3d(1e-3, 1e-3, 1), Vector3d(1e-5, 2e-5, 1), Vector3d(1e-5, 1, 1)}) {
    const ConvexHull hull = corners(size, away);
    CHECK(hull_mesh(hull.points).vertices.size() == 8);
    CHECK_NOTHROW(check_part({hull}, "x"));
    const MassProperties solid = mass_properties(std::vector<Part>{{hull}}, 1);
    CHECK((solid.center - away).norm() < 1e-4);
    CHECK(solid.inertia(0, 0) == doctest::Approx((size.y() * size.y() + size.z() * size.z()) / 12).epsilon(1e-3));
  }
  Rng random(5);
  for (const Vector3d& size : {Vector3d(0, 0, 1), Vector3d(0, 1, 1), Vector3d(0, 0.1, 1)}) {
    ConvexHull hull = corners(size, away);
    for (Vector3d& point : hull.points) {
      point += 1e-7 * Vector3d(random.uniform(-1, 1), random.uniform(-1, 1), random.uniform(-1, 1));
    }
    CHECK(hull_mesh(hull.points).vertices.empty());
    CHECK_THROWS_AS(check_part({hull}, "x"), ArgumentError);
  }
}
