// SPDX-License-Identifier: Apache-2.0
#include "wiw/physics/bullet/arm.hpp"

#include <BulletDynamics/Featherstone/btMultiBodyJointLimitConstraint.h>

#include <cmath>

#include "wiw/physics/bullet/convert.hpp"
#include "wiw/physics/world.hpp"

namespace wiw::physics {

namespace {

// Bullet divides by masses and moments: links that weigh nothing get these.
constexpr double kLeastMass = 1e-3;      // kg
constexpr double kLeastMoment = 1e-6;    // kg m2
constexpr double kUnlimitedForce = 1e4;  // N or Nm, for joints without a limit
constexpr double kFriction = 0.8;        // of links; rubber finger tips on plastic

btQuaternion rotation(const Eigen::Matrix3d& matrix) {
  btQuaternion q;
  to_bullet(matrix).getRotation(q);
  return q;
}

/// Bullet integrates even a fixed base, which normalises its rotation at every step: it has to be one that stays.
void place_base(btMultiBody& body, const Pose& pose) {
  body.setBaseWorldTransform(to_bullet(pose));
  btQuaternion rotation = body.getWorldToBaseRot();
  for (int i = 0; i < 16; ++i) rotation.normalize();
  body.setWorldToBaseRot(rotation);
}

}  // namespace

ArmModel::ArmModel(ArticulationPtr source) : articulation(std::move(source)) {
  const auto& links = articulation->links();
  const auto& joints = articulation->joints();
  std::vector<MassProperties> mass;
  std::vector<std::vector<Part>> parts;
  for (std::size_t link = 0; link < links.size(); ++link) {
    const Joint* joint = link == 0 ? nullptr : &joints[link - 1];
    if (joint == nullptr || joint->index >= 0) {
      group_of_link.push_back(static_cast<int>(groups.size()));
      T_group_link.push_back(Pose::Identity());
      const auto parent = joint == nullptr ? -1 : group_of_link[static_cast<std::size_t>(joint->parent)];
      groups.push_back({.joint = static_cast<int>(link) - 1, .parent = parent});
      mass.emplace_back();
      parts.emplace_back();
    } else {
      const auto parent = static_cast<std::size_t>(joint->parent);
      group_of_link.push_back(group_of_link[parent]);
      T_group_link.push_back(T_group_link[parent] * joint->origin);
    }
    const auto group = static_cast<std::size_t>(group_of_link[link]);
    mass[group] = joined(mass[group], moved(links[link].inertial, T_group_link[link]));
    for (const Part& part : links[link].collision) {
      parts[group].push_back({part.shape, T_group_link[link] * part.pose});
      groups[group].part_link.push_back(static_cast<int>(link));
    }
  }
  for (std::size_t i = 0; i < groups.size(); ++i) {
    groups[i].frame = principal_frame(mass[i]);
    groups[i].frame.moments = groups[i].frame.moments.cwiseMax(kLeastMoment);
    groups[i].mass = std::max(mass[i].mass, kLeastMass);
    groups[i].shape = std::make_shared<const CollisionShape>(parts[i], groups[i].frame.pose);
  }
}

Arm::Arm(std::shared_ptr<const ArmModel> model, const Pose& T_world_base, btMultiBodyDynamicsWorld& world)
    : model_(std::move(model)),
      T_world_base_(T_world_base),
      world_(world),
      time_step_(world.getSolverInfo().m_timeStep) {
  make_links();
  world_.addMultiBody(body_.get());
  for (int group = 0; group < static_cast<int>(model_->groups.size()); ++group) make_collider(group);
  make_motors(time_step_);
  const JointLimits& limits = articulation().limits();
  const Eigen::VectorXd near_zero = Eigen::VectorXd::Zero(articulation().dof()).cwiseMax(limits.lower);
  set_positions(articulation().apply_mimics(near_zero.cwiseMin(limits.upper)));
  set_targets(positions());
  set_forces(limits.effort.cwiseMin(kUnlimitedForce));
}

Arm::~Arm() {
  for (const auto& each : motors_) world_.removeMultiBodyConstraint(each.get());
  for (const auto& each : limits_) world_.removeMultiBodyConstraint(each.get());
  for (const auto& each : colliders_) world_.removeCollisionObject(each.get());
  world_.removeMultiBody(body_.get());
}

void Arm::make_links() {
  const std::vector<LinkGroup>& groups = model_->groups;
  const int links = static_cast<int>(groups.size()) - 1;
  body_ = std::make_unique<btMultiBody>(links, groups[0].mass, to_bullet(groups[0].frame.moments), true, false);
  place_base(*body_, T_world_base_ * groups[0].frame.pose);
  link_of_joint_.resize(static_cast<std::size_t>(articulation().dof()));
  for (int i = 0; i < links; ++i) {
    const LinkGroup& group = groups[static_cast<std::size_t>(i) + 1];
    const Joint& joint = articulation().joints()[static_cast<std::size_t>(group.joint)];
    const LinkGroup& parent = groups[static_cast<std::size_t>(group.parent)];
    // The joint hangs on a link of the parent's group; Bullet's frames are the principal ones.
    const Pose hinge =
        parent.frame.pose.inverse() * model_->T_group_link[static_cast<std::size_t>(joint.parent)] * joint.origin;
    const Eigen::Matrix3d to_own = group.frame.pose.linear().transpose();
    const btQuaternion parent_to_this = rotation((hinge.linear() * group.frame.pose.linear()).transpose());
    const btVector3 axis = to_bullet(Eigen::Vector3d(to_own * joint.axis));
    const btVector3 to_pivot = to_bullet(Eigen::Vector3d(hinge.translation()));
    const btVector3 to_center = to_bullet(Eigen::Vector3d(to_own * group.frame.pose.translation()));
    const btVector3 moments = to_bullet(group.frame.moments);
    if (joint.type == JointType::kRevolute) {
      body_->setupRevolute(i, group.mass, moments, group.parent - 1, parent_to_this, axis, to_pivot, to_center, true);
    } else {
      body_->setupPrismatic(i, group.mass, moments, group.parent - 1, parent_to_this, axis, to_pivot, to_center, true);
    }
    link_of_joint_[static_cast<std::size_t>(joint.index)] = i;
  }
  body_->finalizeMultiDof();
  body_->setCanSleep(false);
  body_->setHasSelfCollision(false);
  body_->setLinearDamping(0);
  body_->setAngularDamping(0);
}

void Arm::make_collider(int group) {
  const LinkGroup& from = model_->groups[static_cast<std::size_t>(group)];
  const bool touches = !from.shape->empty();
  // Bullet solves the motor and the limits of a link together with its collider's contacts; without one, never.
  if (group == 0 && !touches) return;
  auto collider = std::make_unique<btMultiBodyLinkCollider>(body_.get(), group - 1);
  collider->setCollisionShape(touches ? from.shape->root() : &no_shape_);
  collider->setFriction(kFriction);
  collider->setUserIndex2(group);
  collider->setActivationState(DISABLE_DEACTIVATION);
  int kind = btBroadphaseProxy::DefaultFilter, meets = touches ? int{btBroadphaseProxy::AllFilter} : 0;
  if (group == 0) {
    body_->setBaseCollider(collider.get());
    collider->setCollisionFlags(collider->getCollisionFlags() | btCollisionObject::CF_STATIC_OBJECT);
    kind = btBroadphaseProxy::StaticFilter;
    meets = btBroadphaseProxy::AllFilter ^ btBroadphaseProxy::StaticFilter;
  } else {
    body_->getLink(group - 1).m_collider = collider.get();
  }
  world_.addCollisionObject(collider.get(), kind, meets);
  world_.updateSingleAabb(collider.get());  // with the range of contacts, which adding leaves out
  colliders_.push_back(std::move(collider));
}

void Arm::make_motors(double time_step) {
  const JointLimits& limits = articulation().limits();
  for (int joint = 0; joint < articulation().dof(); ++joint) {
    const int link = link_of_joint_[static_cast<std::size_t>(joint)];
    if (std::isfinite(limits.lower[joint]) || std::isfinite(limits.upper[joint])) {
      limits_.push_back(std::make_unique<btMultiBodyJointLimitConstraint>(body_.get(), link, limits.lower[joint],
                                                                          limits.upper[joint]));
      world_.addMultiBodyConstraint(limits_.back().get());
    }
    motors_.push_back(std::make_unique<btMultiBodyJointMotor>(body_.get(), link, 0, 0));
    motors_.back()->setErp(1);
    motors_.back()->setRhsClamp(std::min(limits.velocity[joint], 1 / time_step));
    world_.addMultiBodyConstraint(motors_.back().get());
    motors_.back()->finalizeMultiDof();
  }
}

void Arm::set_index(int index) {
  for (const auto& collider : colliders_) collider->setUserIndex(-1 - index);
}

Eigen::VectorXd Arm::positions() const {
  Eigen::VectorXd values(articulation().dof());
  for (int i = 0; i < values.size(); ++i) values[i] = body_->getJointPos(link_of_joint_[static_cast<std::size_t>(i)]);
  return values;
}

Eigen::VectorXd Arm::velocities() const {
  Eigen::VectorXd values(articulation().dof());
  for (int i = 0; i < values.size(); ++i) values[i] = body_->getJointVel(link_of_joint_[static_cast<std::size_t>(i)]);
  return values;
}

void Arm::set_positions(const Eigen::VectorXd& positions) {
  for (int i = 0; i < positions.size(); ++i) {
    body_->setJointPos(link_of_joint_[static_cast<std::size_t>(i)], positions[i]);
  }
  btAlignedObjectArray<btQuaternion> rotations;
  btAlignedObjectArray<btVector3> origins;
  body_->forwardKinematics(rotations, origins);
  body_->updateCollisionObjectWorldTransforms(rotations, origins);
  for (const auto& collider : colliders_) world_.updateSingleAabb(collider.get());
}

void Arm::set_velocities(const Eigen::VectorXd& velocities) {
  for (int i = 0; i < velocities.size(); ++i) {
    body_->setJointVel(link_of_joint_[static_cast<std::size_t>(i)], velocities[i]);
  }
}

void Arm::set_targets(const Eigen::VectorXd& targets) {
  targets_ = targets;
  for (int i = 0; i < targets.size(); ++i) {
    motors_[static_cast<std::size_t>(i)]->setPositionTarget(targets[i], World::kMotorGain);
  }
}

void Arm::set_forces(const Eigen::VectorXd& forces) {
  forces_ = forces;
  for (int i = 0; i < forces.size(); ++i) {
    motors_[static_cast<std::size_t>(i)]->setMaxAppliedImpulse(forces[i] * time_step_);
  }
}

Pose Arm::frame_pose(int group) const {
  const LinkGroup& of = model_->groups[static_cast<std::size_t>(group)];
  return T_world_base_ * articulation().forward_kinematics(positions())[static_cast<std::size_t>(of.joint + 1)] *
         of.frame.pose;
}

Pose Arm::simulated_frame_pose(int group) const {
  btAlignedObjectArray<btQuaternion> rotations;
  btAlignedObjectArray<btVector3> origins;
  body_->forwardKinematics(rotations, origins);
  return to_eigen(group == 0 ? body_->getBaseWorldTransform() : body_->getLink(group - 1).m_cachedWorldTransform);
}

}  // namespace wiw::physics
