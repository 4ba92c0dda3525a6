// SPDX-License-Identifier: Apache-2.0
#include "wiw/scene/sdf/primitives.hpp"

#include <cmath>
#include <numbers>
#include <vector>

namespace wiw::scene::sdf {
namespace {

constexpr int kSlices = 32;  // around the axis
constexpr int kRings = 16;   // from pole to pole

struct Builder {
  std::vector<Eigen::Vector3f> positions;
  std::vector<Eigen::Vector3f> normals;
  std::vector<Eigen::Matrix<std::uint32_t, 3, 1>> triangles;

  std::uint32_t vertex(const Eigen::Vector3d& position, const Eigen::Vector3d& normal) {
    positions.emplace_back(position.cast<float>());
    normals.emplace_back(normal.cast<float>());
    return static_cast<std::uint32_t>(positions.size() - 1);
  }

  /// Parallelogram about `centre`; its normal is u x v.
  void quad(const Eigen::Vector3d& centre, const Eigen::Vector3d& u, const Eigen::Vector3d& v) {
    const Eigen::Vector3d normal = u.cross(v).normalized();
    const std::uint32_t first = vertex(centre - u - v, normal);
    vertex(centre + u - v, normal);
    vertex(centre + u + v, normal);
    vertex(centre - u + v, normal);
    triangles.emplace_back(first, first + 1, first + 2);
    triangles.emplace_back(first, first + 2, first + 3);
  }

  Mesh mesh() && {
    return {.positions = std::move(positions), .normals = std::move(normals), .triangles = std::move(triangles)};
  }
};

Eigen::Vector3d around(int slice) {
  const double angle = 2. * std::numbers::pi * slice / kSlices;
  return {std::cos(angle), std::sin(angle), 0.};
}

Mesh box(const Eigen::Vector3d& size) {
  Builder builder;
  for (int axis = 0; axis < 3; ++axis) {
    const Eigen::Vector3d n = 0.5 * size[axis] * Eigen::Vector3d::Unit(axis);
    const Eigen::Vector3d u = 0.5 * size[(axis + 1) % 3] * Eigen::Vector3d::Unit((axis + 1) % 3);
    const Eigen::Vector3d v = 0.5 * size[(axis + 2) % 3] * Eigen::Vector3d::Unit((axis + 2) % 3);
    builder.quad(n, u, v);
    builder.quad(-n, v, u);
  }
  return std::move(builder).mesh();
}

Mesh sphere(double radius) {
  Builder builder;
  for (int ring = 0; ring <= kRings; ++ring) {
    const double polar = std::numbers::pi * ring / kRings;
    for (int slice = 0; slice < kSlices; ++slice) {
      const Eigen::Vector3d normal = std::sin(polar) * around(slice) + std::cos(polar) * Eigen::Vector3d::UnitZ();
      builder.vertex(radius * normal, normal);
    }
  }
  for (int ring = 0; ring < kRings; ++ring) {
    for (int slice = 0; slice < kSlices; ++slice) {
      const auto a = static_cast<std::uint32_t>(ring * kSlices + slice);
      const auto b = static_cast<std::uint32_t>(ring * kSlices + (slice + 1) % kSlices);
      if (ring > 0) builder.triangles.emplace_back(a, b + kSlices, b);
      if (ring < kRings - 1) builder.triangles.emplace_back(a, a + kSlices, b + kSlices);
    }
  }
  return std::move(builder).mesh();
}

Mesh cylinder(double radius, double length) {
  Builder builder;
  const Eigen::Vector3d half = 0.5 * length * Eigen::Vector3d::UnitZ();
  for (int slice = 0; slice < kSlices; ++slice) {
    const Eigen::Vector3d n0 = around(slice);
    const Eigen::Vector3d n1 = around(slice + 1);
    const std::uint32_t first = builder.vertex(radius * n0 - half, n0);
    builder.vertex(radius * n1 - half, n1);
    builder.vertex(radius * n1 + half, n1);
    builder.vertex(radius * n0 + half, n0);
    builder.triangles.emplace_back(first, first + 1, first + 2);
    builder.triangles.emplace_back(first, first + 2, first + 3);
  }
  for (const double side : {1., -1.}) {
    const Eigen::Vector3d normal = side * Eigen::Vector3d::UnitZ();
    const std::uint32_t centre = builder.vertex(side * half, normal);
    for (int slice = 0; slice < kSlices; ++slice) builder.vertex(side * half + radius * around(slice), normal);
    for (int slice = 0; slice < kSlices; ++slice) {
      const std::uint32_t a = centre + 1 + static_cast<std::uint32_t>(slice);
      const std::uint32_t b = centre + 1 + static_cast<std::uint32_t>((slice + 1) % kSlices);
      builder.triangles.emplace_back(centre, side > 0. ? a : b, side > 0. ? b : a);
    }
  }
  return std::move(builder).mesh();
}

Mesh plane(const Geometry& geometry) {
  Builder builder;
  const Eigen::Quaterniond turn = Eigen::Quaterniond::FromTwoVectors(Eigen::Vector3d::UnitZ(), geometry.normal);
  builder.quad(Eigen::Vector3d::Zero(), turn * Eigen::Vector3d(0.5 * geometry.size.x(), 0., 0.),
               turn * Eigen::Vector3d(0., 0.5 * geometry.size.y(), 0.));
  return std::move(builder).mesh();
}

}  // namespace

Mesh primitive_mesh(const Geometry& geometry) {
  switch (geometry.shape) {
    case ShapeKind::kBox: return box(geometry.size);
    case ShapeKind::kSphere: return sphere(geometry.size.x());
    case ShapeKind::kCylinder: return cylinder(geometry.size.x(), geometry.size.z());
    case ShapeKind::kPlane: return plane(geometry);
    case ShapeKind::kMesh: break;
  }
  return {};
}

}  // namespace wiw::scene::sdf
