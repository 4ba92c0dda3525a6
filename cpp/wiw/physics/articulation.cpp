// SPDX-License-Identifier: Apache-2.0
#include "wiw/physics/articulation.hpp"

#include <algorithm>
#include <cmath>

#include "wiw/core/error.hpp"

namespace wiw::physics {

namespace {

std::string listed(const std::vector<std::string>& names) {
  std::string text;
  for (const std::string& name : names) text += (text.empty() ? "" : ", ") + name;
  return text;
}

int find(const std::vector<std::string>& names, const std::string& name, const std::string& what) {
  const auto found = std::find(names.begin(), names.end(), name);
  if (found != names.end()) return static_cast<int>(found - names.begin());
  throw ArgumentError("no " + what + " '" + name + "'; there are " + listed(names));
}

}  // namespace

Pose joint_transform(const Joint& joint, double q) {
  Pose pose = joint.origin;
  if (joint.type == JointType::kRevolute) pose.rotate(Eigen::AngleAxisd(q, joint.axis));
  if (joint.type == JointType::kPrismatic) pose.translate(q * joint.axis);
  return pose;
}

Articulation::Articulation(std::string name, std::vector<Link> links, std::vector<Joint> joints, JointLimits limits)
    : name_(std::move(name)), links_(std::move(links)), joints_(std::move(joints)), limits_(std::move(limits)) {}

std::vector<std::string> Articulation::movable_joints() const {
  std::vector<std::string> names;
  for (const Joint& joint : joints_) {
    if (joint.index >= 0) names.push_back(joint.name);
  }
  return names;
}

int Articulation::link_index(const std::string& name) const {
  std::vector<std::string> names;
  names.reserve(links_.size());
  for (const Link& link : links_) names.push_back(link.name);
  return find(names, name, "link");
}

int Articulation::joint_index(const std::string& name) const { return find(movable_joints(), name, "movable joint"); }

void Articulation::check_positions(const Eigen::VectorXd& positions, const char* what) const {
  if (positions.size() != dof()) {
    throw ArgumentError(std::string(what) + ": expected " + std::to_string(dof()) + " numbers, one a movable joint (" +
                        listed(movable_joints()) + "), got " + std::to_string(positions.size()));
  }
  if (!positions.allFinite()) throw ArgumentError(std::string(what) + ": expected finite numbers, got NaN or infinity");
}

void Articulation::check_within_limits(const Eigen::VectorXd& positions, const char* what) const {
  check_positions(positions, what);
  for (int i = 0; i < dof(); ++i) {
    if (positions[i] >= limits_.lower[i] - 1e-6 && positions[i] <= limits_.upper[i] + 1e-6) continue;
    throw ArgumentError(std::string(what) + ": joint '" + movable_joints()[static_cast<std::size_t>(i)] +
                        "' takes positions in [" + std::to_string(limits_.lower[i]) + ", " +
                        std::to_string(limits_.upper[i]) + "], got " + std::to_string(positions[i]));
  }
}

Eigen::VectorXd Articulation::apply_mimics(Eigen::VectorXd positions) const {
  for (const Joint& joint : joints_) {
    if (!joint.mimic) continue;
    const double wanted = joint.mimic->multiplier * positions[joint.mimic->index] + joint.mimic->offset;
    positions[joint.index] = std::clamp(wanted, limits_.lower[joint.index], limits_.upper[joint.index]);
  }
  return positions;
}

std::vector<Pose> Articulation::forward_kinematics(const Eigen::VectorXd& positions) const {
  check_positions(positions, "positions");
  std::vector<Pose> poses{Pose::Identity()};
  poses.reserve(links_.size());
  for (const Joint& joint : joints_) {
    const double q = joint.index < 0 ? 0 : positions[joint.index];
    poses.push_back(poses[static_cast<std::size_t>(joint.parent)] * joint_transform(joint, q));
  }
  return poses;
}

Eigen::MatrixXd Articulation::jacobian(const Eigen::VectorXd& positions, int link) const {
  const std::vector<Pose> poses = forward_kinematics(positions);
  const Eigen::Vector3d tip = poses.at(static_cast<std::size_t>(link)).translation();
  Eigen::MatrixXd jacobian = Eigen::MatrixXd::Zero(6, dof());
  for (int at = link; at > 0; at = joints_[static_cast<std::size_t>(at) - 1].parent) {
    const Joint& joint = joints_[static_cast<std::size_t>(at) - 1];
    if (joint.index < 0) continue;
    // A joint's motion keeps its own axis, so the child's frame tells it as well as the parent's.
    const Pose& child = poses[static_cast<std::size_t>(at)];
    const Eigen::Vector3d axis = child.linear() * joint.axis;
    if (joint.type == JointType::kPrismatic) {
      jacobian.col(joint.index).head<3>() = axis;
    } else {
      jacobian.col(joint.index).head<3>() = axis.cross(tip - child.translation());
      jacobian.col(joint.index).tail<3>() = axis;
    }
  }
  return jacobian;
}

}  // namespace wiw::physics
