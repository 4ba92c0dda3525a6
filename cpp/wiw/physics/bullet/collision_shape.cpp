// SPDX-License-Identifier: Apache-2.0
#include "wiw/physics/bullet/collision_shape.hpp"

#include <btBulletCollisionCommon.h>

#include <cmath>

#include "wiw/core/intrinsics.hpp"
#include "wiw/physics/bullet/convert.hpp"

namespace wiw::physics {

namespace {

/// Bullet rounds hulls off outwards by this much (its default, 4 cm, is the size of the things we grasp).
constexpr double kMargin = 1e-4;
/// Cylinders are prisms to Bullet: flat faces stand firmly, where smooth ones touch in one wandering point.
constexpr int kCylinderSides = 32;

struct ToBulletShape {
  using Result = std::unique_ptr<btCollisionShape>;
  Result operator()(const Box& box) const {
    auto shape = std::make_unique<btBoxShape>(to_bullet(Eigen::Vector3d(box.size / 2)));
    return finished(std::move(shape));
  }
  Result operator()(const Sphere& sphere) const { return std::make_unique<btSphereShape>(sphere.radius); }
  Result operator()(const Cylinder& cylinder) const {
    std::vector<Eigen::Vector3d> prism;
    for (int i = 0; i < kCylinderSides; ++i) {
      const double angle = 2 * kPi * i / kCylinderSides;
      const double x = cylinder.radius * std::cos(angle), y = cylinder.radius * std::sin(angle);
      prism.emplace_back(x, y, -cylinder.length / 2);
      prism.emplace_back(x, y, cylinder.length / 2);
    }
    return of_vertices(thin_hull_mesh(prism).vertices);
  }
  Result operator()(const Capsule& capsule) const {
    return std::make_unique<btCapsuleShapeZ>(capsule.radius, capsule.length);
  }
  Result operator()(const ConvexHull& hull) const { return of_vertices(hull_mesh(hull.points).vertices); }
  static Result of_vertices(const std::vector<Eigen::Vector3d>& vertices) {
    auto shape = std::make_unique<btConvexHullShape>();
    for (const Eigen::Vector3d& vertex : vertices) shape->addPoint(to_bullet(vertex), false);
    shape->recalcLocalAabb();
    return finished(std::move(shape));
  }
  /// With its faces known, two polyhedra meet in a whole patch of points at once.
  static Result finished(std::unique_ptr<btPolyhedralConvexShape> shape) {
    btVector3 low, high;
    shape->getAabb(btTransform::getIdentity(), low, high);
    const btVector3 size = high - low;
    shape->setMargin(std::min(kMargin, 0.05 * size[size.minAxis()]));
    shape->initializePolyhedralFeatures();
    return shape;
  }
};

}  // namespace

CollisionShape::CollisionShape(std::span<const Part> parts, const Pose& frame) {
  if (parts.empty()) return;
  for (const Part& part : parts) owned_.push_back(std::visit(ToBulletShape{}, part.shape));
  const Pose to_frame = frame.inverse();
  if (parts.size() == 1 && (to_frame * parts[0].pose).isApprox(Pose::Identity(), 1e-12)) {
    root_ = owned_[0].get();
    return;
  }
  auto compound = std::make_unique<btCompoundShape>(true, static_cast<int>(parts.size()));
  for (std::size_t i = 0; i < parts.size(); ++i) {
    compound->addChildShape(to_bullet(Pose(to_frame * parts[i].pose)), owned_[i].get());
  }
  root_ = compound.get();
  owned_.push_back(std::move(compound));
}

}  // namespace wiw::physics
