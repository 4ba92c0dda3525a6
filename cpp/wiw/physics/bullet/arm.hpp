// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <BulletCollision/CollisionShapes/btEmptyShape.h>
#include <BulletDynamics/Featherstone/btMultiBody.h>
#include <BulletDynamics/Featherstone/btMultiBodyConstraint.h>
#include <BulletDynamics/Featherstone/btMultiBodyDynamicsWorld.h>
#include <BulletDynamics/Featherstone/btMultiBodyJointMotor.h>
#include <BulletDynamics/Featherstone/btMultiBodyLinkCollider.h>

#include <memory>
#include <vector>

#include "wiw/physics/articulation.hpp"
#include "wiw/physics/bullet/collision_shape.hpp"

namespace wiw::physics {

/// Links joined by fixed joints move as one and are one link to Bullet.
struct LinkGroup {
  int joint = -1;  // the movable joint (index in Articulation::joints) that carries it; -1: the base
  int parent = -1;
  PrincipalFrame frame;  // in the frame of the group's first link
  double mass = 0;
  std::vector<int> part_link;  // link of each part of `shape`
  std::shared_ptr<const CollisionShape> shape;
};

/// What worlds share of an articulation: groups in Bullet's order, the base first.
struct ArmModel {
  explicit ArmModel(ArticulationPtr articulation);
  ArticulationPtr articulation;
  std::vector<LinkGroup> groups;
  std::vector<int> group_of_link;
  std::vector<Pose> T_group_link;  // group: the group's first link
};

/// An articulation in a Bullet world: the multibody, its colliders, motors and joint limits.
class Arm {
 public:
  Arm(std::shared_ptr<const ArmModel> model, const Pose& T_world_base, btMultiBodyDynamicsWorld& world);
  ~Arm();
  Arm(const Arm&) = delete;
  Arm& operator=(const Arm&) = delete;

  [[nodiscard]] const std::shared_ptr<const ArmModel>& model() const { return model_; }
  [[nodiscard]] const Articulation& articulation() const { return *model_->articulation; }
  [[nodiscard]] const Pose& base() const { return T_world_base_; }
  [[nodiscard]] btMultiBody& multibody() { return *body_; }
  /// Sets the articulation's index, by which contacts name it.
  void set_index(int index);

  [[nodiscard]] Eigen::VectorXd positions() const;
  [[nodiscard]] Eigen::VectorXd velocities() const;
  [[nodiscard]] const Eigen::VectorXd& targets() const { return targets_; }
  [[nodiscard]] const Eigen::VectorXd& forces() const { return forces_; }
  /// Colliders follow.
  void set_positions(const Eigen::VectorXd& positions);
  void set_velocities(const Eigen::VectorXd& velocities);
  void set_targets(const Eigen::VectorXd& targets);
  void set_forces(const Eigen::VectorXd& forces);

  /// T_world_frame of a group's principal frame, by forward kinematics.
  [[nodiscard]] Pose frame_pose(int group) const;
  /// The same by Bullet's.
  [[nodiscard]] Pose simulated_frame_pose(int group) const;

 private:
  void make_links();
  void make_collider(int group);
  void make_motors(double time_step);

  std::shared_ptr<const ArmModel> model_;
  const Pose T_world_base_;
  btMultiBodyDynamicsWorld& world_;
  const double time_step_;
  std::unique_ptr<btMultiBody> body_;
  btEmptyShape no_shape_;  // of links that touch nothing
  std::vector<std::unique_ptr<btMultiBodyLinkCollider>> colliders_;
  std::vector<std::unique_ptr<btMultiBodyConstraint>> limits_;
  std::vector<std::unique_ptr<btMultiBodyJointMotor>> motors_;  // by movable joint
  std::vector<int> link_of_joint_;                              // Bullet's link by movable joint
  Eigen::VectorXd targets_, forces_;
};

}  // namespace wiw::physics
