// SPDX-License-Identifier: Apache-2.0
#include "wiw/physics/gripper.hpp"

#include <algorithm>
#include <cmath>
#include <set>

#include "wiw/core/error.hpp"

namespace wiw::physics {

namespace {

constexpr double kTouching = 5e-4;  // metres
constexpr double kStill = 2e-3;     // metres a second
constexpr int kStillSteps = 6;      // in a row, so that a finger that turns round does not count

}  // namespace

Gripper::Gripper(World& world, int articulation, const GripperNames& names, double force)
    : world_(world), articulation_(articulation), force_(force) {
  const Articulation& model = *world.articulation(articulation);
  for (std::size_t i = 0; i < 2; ++i) {
    joints_[i] = model.joint_index(names.joints[i]);
    fingers_[i] = model.link_index(names.fingers[i]);
    const double range = model.limits().upper[joints_[i]] - model.limits().lower[joints_[i]];
    if (!std::isfinite(range) || range <= 0)
      throw ArgumentError("joint '" + names.joints[i] + "' of the gripper has no range");
  }
  hand_ = model.link_index(names.hand);
  if (!(force > 0) || !std::isfinite(force))
    throw ArgumentError("expected a positive force in newtons, got " + std::to_string(force));
}

std::optional<int> Gripper::close(int steps) {
  move(0, steps);
  if (const auto body = held()) return body;
  const auto body = find_body_between_fingers();
  if (body) world_.attach(articulation_, hand_, *body);
  return body;
}

void Gripper::open(double amount, int steps) {
  if (!(amount >= 0 && amount <= 1)) {
    throw ArgumentError("expected a gripper opening in [0, 1], got " + std::to_string(amount));
  }
  world_.detach(articulation_);
  move(amount, steps);
}

void Gripper::move(double amount, int steps) {
  const JointLimits& limits = world_.articulation(articulation_)->limits();
  Eigen::VectorXd targets = world_.joint_targets(articulation_), forces = world_.joint_forces(articulation_);
  for (const int joint : joints_) {
    targets[joint] = limits.lower[joint] + amount * (limits.upper[joint] - limits.lower[joint]);
    forces[joint] = force_;
  }
  world_.set_joint_targets(articulation_, targets);
  world_.set_joint_forces(articulation_, forces);
  for (int i = 0, rest = 0; i < steps && rest < kStillSteps; ++i) {
    world_.step();
    rest = still() ? rest + 1 : 0;
  }
}

bool Gripper::still() const {
  const Eigen::VectorXd velocities = world_.joint_velocities(articulation_);
  return std::abs(velocities[joints_[0]]) < kStill && std::abs(velocities[joints_[1]]) < kStill;
}

double Gripper::opening() const {
  const JointLimits& limits = world_.articulation(articulation_)->limits();
  const Eigen::VectorXd positions = world_.joint_positions(articulation_);
  double sum = 0;
  for (const int joint : joints_) {
    sum += (positions[joint] - limits.lower[joint]) / (limits.upper[joint] - limits.lower[joint]);
  }
  return std::clamp(sum / 2, 0.0, 1.0);
}

std::optional<int> Gripper::held() const {
  for (const Attachment& each : world_.attachments()) {
    if (each.articulation == articulation_ && each.link == hand_) return each.body;
  }
  return std::nullopt;
}

std::optional<int> Gripper::find_body_between_fingers() {
  std::array<std::set<int>, 2> touched;
  for (const Contact& contact : world_.contacts(kTouching)) {
    for (const auto& [ours, theirs] : {std::pair(contact.a, contact.b), std::pair(contact.b, contact.a)}) {
      if (ours.articulation != articulation_ || theirs.body < 0 || world_.body(theirs.body).mass == 0) continue;
      for (std::size_t i = 0; i < 2; ++i) {
        if (ours.link == fingers_[i]) touched[i].insert(theirs.body);
      }
    }
  }
  for (const int body : touched[0]) {
    if (touched[1].contains(body)) return body;
  }
  return std::nullopt;
}

}  // namespace wiw::physics
