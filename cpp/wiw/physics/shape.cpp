// SPDX-License-Identifier: Apache-2.0
#include "wiw/physics/shape.hpp"

#include <LinearMath/btConvexHullComputer.h>

#include <Eigen/Eigenvalues>
#include <cmath>
#include <sstream>

#include "wiw/core/error.hpp"
#include "wiw/core/intrinsics.hpp"
#include "wiw/physics/bullet/convert.hpp"

namespace wiw::physics {

namespace {

constexpr double kLeastLength = 1e-9;  // metres; products of much smaller ones are zero, and so would be the mass

void check_length(double value, const char* what, const std::string& owner) {
  if (std::isfinite(value) && value >= kLeastLength) return;
  std::ostringstream text;
  text << owner << ": expected a " << what << " of " << kLeastLength << " metres or more, got " << value;
  throw ArgumentError(text.str());
}

struct Check {
  const std::string& owner;
  void operator()(const Box& box) const {
    for (const double size : box.size) check_length(size, "box size", owner);
  }
  void operator()(const Sphere& sphere) const { check_length(sphere.radius, "radius", owner); }
  void operator()(const Cylinder& cylinder) const {
    check_length(cylinder.radius, "radius", owner);
    check_length(cylinder.length, "length", owner);
  }
  void operator()(const Capsule& capsule) const {
    check_length(capsule.radius, "radius", owner);
    check_length(capsule.length, "length", owner);
  }
  void operator()(const ConvexHull& hull) const {
    for (const Eigen::Vector3d& point : hull.points) {
      if (!point.allFinite()) throw ArgumentError(owner + ": a point of the convex hull is not finite");
    }
    if (hull_mesh(hull.points).vertices.empty()) {
      throw ArgumentError(owner + ": a convex hull needs four points that do not lie in one plane, got " +
                          std::to_string(hull.points.size()) + " points");
    }
  }
};

Eigen::Matrix3d diagonal(double x, double y, double z) { return Eigen::Vector3d(x, y, z).asDiagonal(); }

/// Volume, centre and inertia at density 1.
struct UnitDensity {
  MassProperties operator()(const Box& box) const {
    const Eigen::Vector3d s = box.size.cwiseAbs2();
    const double volume = box.size.prod();
    return {.mass = volume, .inertia = volume / 12 * diagonal(s.y() + s.z(), s.x() + s.z(), s.x() + s.y())};
  }
  MassProperties operator()(const Sphere& sphere) const {
    const double r2 = sphere.radius * sphere.radius;
    const double volume = 4 * kPi / 3 * r2 * sphere.radius;
    return {.mass = volume, .inertia = 0.4 * volume * r2 * Eigen::Matrix3d::Identity()};
  }
  MassProperties operator()(const Cylinder& cylinder) const {
    const double r2 = cylinder.radius * cylinder.radius;
    const double volume = kPi * r2 * cylinder.length;
    const double across = volume * (3 * r2 + cylinder.length * cylinder.length) / 12;
    return {.mass = volume, .inertia = diagonal(across, across, volume * r2 / 2)};
  }
  MassProperties operator()(const Capsule& capsule) const {
    MassProperties all = (*this)(Cylinder{capsule.radius, capsule.length});
    const double r = capsule.radius;
    // A half ball's centre of mass lies 3/8 r above its base; its inertia about the base centre is that of the ball.
    const double half = 2 * kPi / 3 * r * r * r;
    const double base = 0.4 * half * r * r;
    const double lever = capsule.length / 2 + 3 * r / 8;
    const double across = base - half * 9 * r * r / 64 + half * lever * lever;
    all.mass += 2 * half;
    all.inertia += 2 * diagonal(across, across, base);
    return all;
  }
  MassProperties operator()(const ConvexHull& hull) const {
    // Sum over the tetrahedra that the triangles span with the origin (Tonon, 2004): with vertices a, b, c the second
    // moments are det / 120 (sum of v v^T over a, b, c and a + b + c).
    const HullMesh mesh = hull_mesh(hull.points);
    double volume = 0;
    Eigen::Vector3d first = Eigen::Vector3d::Zero();
    Eigen::Matrix3d second = Eigen::Matrix3d::Zero();
    for (const Eigen::Vector3i& t : mesh.triangles) {
      const Eigen::Vector3d &a = mesh.vertices[t.x()], &b = mesh.vertices[t.y()], &c = mesh.vertices[t.z()];
      const double det = a.dot(b.cross(c));
      const Eigen::Vector3d sum = a + b + c;
      volume += det / 6;
      first += det / 24 * sum;
      second += det / 120 * (a * a.transpose() + b * b.transpose() + c * c.transpose() + sum * sum.transpose());
    }
    const Eigen::Vector3d center = first / volume;
    second -= volume * center * center.transpose();
    return {.mass = volume, .center = center, .inertia = second.trace() * Eigen::Matrix3d::Identity() - second};
  }
};

/// Thinner than a few millionths of its extent, so that rounding may have made what thickness there is. The volume of a
/// convex body is its surface times a sixth to a half of its thickness, for slabs and for rods; of its extent cubed, a
/// rod has next to nothing however stout it is.
bool is_flat(const HullMesh& mesh) {
  if (mesh.vertices.empty()) return true;
  Eigen::AlignedBox3d bounds;
  double volume = 0, surface = 0;
  for (const Eigen::Vector3d& vertex : mesh.vertices) bounds.extend(vertex);
  const Eigen::Vector3d origin = mesh.vertices[0];
  for (const Eigen::Vector3i& t : mesh.triangles) {
    const Eigen::Vector3d a = mesh.vertices[t.x()] - origin, b = mesh.vertices[t.y()] - origin,
                          c = mesh.vertices[t.z()] - origin;
    volume += a.dot(b.cross(c)) / 6;
    surface += (b - a).cross(c - a).norm() / 2;
  }
  return std::abs(volume) <= 1e-6 * bounds.diagonal().norm() * surface;
}

}  // namespace

void check_pose(const Pose& pose, const std::string& what) {
  const Eigen::Matrix3d rotation = pose.linear();
  if (pose.matrix().allFinite() && (rotation * rotation.transpose()).isIdentity(1e-6) && rotation.determinant() > 0) {
    return;
  }
  throw ArgumentError(what + " is not a rigid transform: expected finite numbers and an orthonormal rotation");
}

void check_part(const Part& part, const std::string& owner) {
  check_pose(part.pose, owner + ": a part's pose");
  std::visit(Check{owner}, part.shape);
}

HullMesh thin_hull_mesh(std::span<const Eigen::Vector3d> points) {
  HullMesh mesh;
  btConvexHullComputer computer;
  computer.compute(points[0].data(), sizeof(Eigen::Vector3d), static_cast<int>(points.size()), 0, 0);
  // Bullet computes on a grid; the vertices themselves are taken from the input.
  for (int i = 0; i < computer.vertices.size(); ++i) {
    mesh.vertices.push_back(points[static_cast<std::size_t>(computer.original_vertex_index[i])]);
  }
  for (int i = 0; i < computer.faces.size(); ++i) {
    const btConvexHullComputer::Edge* first = &computer.edges[computer.faces[i]];
    const int apex = first->getSourceVertex();
    for (const auto* edge = first->getNextEdgeOfFace(); edge->getTargetVertex() != apex;
         edge = edge->getNextEdgeOfFace()) {
      mesh.triangles.emplace_back(apex, edge->getSourceVertex(), edge->getTargetVertex());
    }
  }
  return mesh;
}

HullMesh hull_mesh(std::span<const Eigen::Vector3d> points) {
  if (points.size() < 4) return {};
  HullMesh mesh = thin_hull_mesh(points);
  return is_flat(mesh) ? HullMesh{} : mesh;
}

MassProperties moved(const MassProperties& properties, const Pose& pose) {
  const Eigen::Matrix3d rotation = pose.linear();
  return {properties.mass, pose * properties.center, rotation * properties.inertia * rotation.transpose()};
}

MassProperties joined(const MassProperties& a, const MassProperties& b) {
  MassProperties all{.mass = a.mass + b.mass};
  if (all.mass <= 0) return all;
  all.center = (a.mass * a.center + b.mass * b.center) / all.mass;
  for (const MassProperties* each : {&a, &b}) {
    const Eigen::Vector3d d = each->center - all.center;
    all.inertia += each->inertia + each->mass * (d.squaredNorm() * Eigen::Matrix3d::Identity() - d * d.transpose());
  }
  return all;
}

MassProperties mass_properties(std::span<const Part> parts, double mass) {
  MassProperties all;
  for (const Part& part : parts) all = joined(all, moved(std::visit(UnitDensity{}, part.shape), part.pose));
  all.inertia *= mass / all.mass;
  all.mass = mass;
  return all;
}

PrincipalFrame principal_frame(const MassProperties& properties) {
  PrincipalFrame frame;
  frame.pose.translation() = properties.center;
  frame.moments = properties.inertia.diagonal();
  const Eigen::Matrix3d off = properties.inertia - Eigen::Matrix3d(frame.moments.asDiagonal());
  if (off.cwiseAbs().maxCoeff() <= 1e-9 * properties.inertia.trace()) return frame;
  const Eigen::SelfAdjointEigenSolver<Eigen::Matrix3d> solver(properties.inertia);
  Eigen::Matrix3d axes = solver.eigenvectors();
  if (axes.determinant() < 0) axes.col(0) = -axes.col(0);
  frame.pose.linear() = axes;
  frame.moments = solver.eigenvalues();
  return frame;
}

}  // namespace wiw::physics
