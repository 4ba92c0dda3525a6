// SPDX-License-Identifier: Apache-2.0
#include "wiw/physics/bullet/rigid.hpp"

#include <cmath>

#include "wiw/core/error.hpp"
#include "wiw/physics/bullet/convert.hpp"

namespace wiw::physics {

namespace {

Body checked(Body body) {
  const std::string who = "body '" + body.name + "'";
  if (body.parts.empty()) throw ArgumentError(who + " has no parts; expected one shape or more");
  for (const Part& part : body.parts) check_part(part, who);
  check_pose(body.T_world_body, who + ": T_world_body");
  const auto check = [&](double value, double high, const char* what) {
    if (std::isfinite(value) && value >= 0 && value <= high) return;
    throw ArgumentError(who + ": expected " + what + ", got " + std::to_string(value));
  };
  check(body.mass, 1e6, "a mass of 0 (static) to 1e6 kg");
  check(body.friction, 1e3, "a friction of 0 to 1000");
  check(body.restitution, 1, "a restitution in [0, 1]");
  return body;
}

}  // namespace

RigidModel::RigidModel(Body wanted)
    : body(checked(std::move(wanted))),
      frame(body.mass > 0 ? principal_frame(mass_properties(body.parts, body.mass)) : PrincipalFrame{}),
      shape(body.parts, frame.pose) {}

Rigid::Rigid(std::shared_ptr<const RigidModel> model, btMultiBodyDynamicsWorld& world, int index)
    : model_(std::move(model)), frame_to_body_(model_->frame.pose.inverse()), world_(world) {
  const Body& body = model_->body;
  btRigidBody::btRigidBodyConstructionInfo info(body.mass, nullptr, model_->shape.root(),
                                                to_bullet(model_->frame.moments));
  info.m_startWorldTransform = to_bullet(Pose(body.T_world_body * model_->frame.pose));
  info.m_friction = body.friction;
  info.m_restitution = body.restitution;
  object_ = std::make_unique<btRigidBody>(info);
  object_->setUserIndex(index);
  if (body.mass > 0) object_->setActivationState(DISABLE_DEACTIVATION);
  world_.addRigidBody(object_.get());
  world_.updateSingleAabb(object_.get());  // with the range of contacts, which adding leaves out
}

Rigid::~Rigid() { world_.removeRigidBody(object_.get()); }

Pose Rigid::frame_pose() const { return to_eigen(object_->getWorldTransform()); }

Vector6 Rigid::velocity() const {
  Vector6 velocity;
  velocity << to_eigen(object_->getLinearVelocity()), to_eigen(object_->getAngularVelocity());
  return velocity;
}

void Rigid::set_frame_pose(const Pose& pose) {
  object_->setCenterOfMassTransform(to_bullet(pose));
  object_->setInterpolationWorldTransform(object_->getWorldTransform());
  world_.updateSingleAabb(object_.get());
}

void Rigid::set_velocity(const Vector6& velocity) {
  object_->setLinearVelocity(to_bullet(Eigen::Vector3d(velocity.head<3>())));
  object_->setAngularVelocity(to_bullet(Eigen::Vector3d(velocity.tail<3>())));
  object_->setInterpolationLinearVelocity(object_->getLinearVelocity());
  object_->setInterpolationAngularVelocity(object_->getAngularVelocity());
}

}  // namespace wiw::physics
