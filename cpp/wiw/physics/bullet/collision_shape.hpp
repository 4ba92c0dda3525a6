// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <BulletCollision/CollisionShapes/btCollisionShape.h>

#include <memory>
#include <span>
#include <vector>

#include "wiw/physics/shape.hpp"

namespace wiw::physics {

/// Bullet's shape of one rigid body or link. Immutable, so that worlds and threads may share it.
class CollisionShape {
 public:
  /// `frame` is where Bullet's body frame (the principal frame) lies in the frame the parts are given in.
  CollisionShape(std::span<const Part> parts, const Pose& frame);

  [[nodiscard]] btCollisionShape* root() const { return root_; }
  [[nodiscard]] bool empty() const { return root_ == nullptr; }

 private:
  std::vector<std::unique_ptr<btCollisionShape>> owned_;
  btCollisionShape* root_ = nullptr;
};

}  // namespace wiw::physics
