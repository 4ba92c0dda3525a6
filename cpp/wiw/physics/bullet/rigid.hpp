// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <BulletDynamics/Dynamics/btRigidBody.h>
#include <BulletDynamics/Featherstone/btMultiBodyDynamicsWorld.h>

#include "wiw/physics/bullet/collision_shape.hpp"
#include "wiw/physics/world.hpp"

namespace wiw::physics {

/// What worlds share of a body. Throws ArgumentError for impossible numbers.
struct RigidModel {
  explicit RigidModel(Body wanted);
  Body body;
  PrincipalFrame frame;  // in the body's frame
  CollisionShape shape;
};

/// A rigid body in a Bullet world.
class Rigid {
 public:
  Rigid(std::shared_ptr<const RigidModel> model, btMultiBodyDynamicsWorld& world, int index);
  ~Rigid();
  Rigid(const Rigid&) = delete;
  Rigid& operator=(const Rigid&) = delete;

  [[nodiscard]] const RigidModel& model() const { return *model_; }
  [[nodiscard]] btRigidBody& object() { return *object_; }
  /// T_world_frame of the principal frame, to the bit.
  [[nodiscard]] Pose frame_pose() const;
  [[nodiscard]] Pose pose() const { return frame_pose() * frame_to_body_; }
  [[nodiscard]] Vector6 velocity() const;
  void set_frame_pose(const Pose& pose);
  void set_velocity(const Vector6& velocity);

 private:
  std::shared_ptr<const RigidModel> model_;
  const Pose frame_to_body_;
  btMultiBodyDynamicsWorld& world_;
  std::unique_ptr<btRigidBody> object_;
};

}  // namespace wiw::physics
