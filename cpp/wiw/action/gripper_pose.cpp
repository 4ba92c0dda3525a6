// SPDX-License-Identifier: Apache-2.0
#include "wiw/action/gripper_pose.hpp"

#include <algorithm>
#include <cmath>

#include "wiw/core/error.hpp"

namespace wiw::action {

Eigen::Quaterniond to_quaternion(const Eigen::Vector3d& rpy) {
  return Eigen::AngleAxisd(rpy.z(), Eigen::Vector3d::UnitZ()) * Eigen::AngleAxisd(rpy.y(), Eigen::Vector3d::UnitY()) *
         Eigen::AngleAxisd(rpy.x(), Eigen::Vector3d::UnitX());
}

Eigen::Vector3d to_rpy(const Eigen::Quaterniond& rotation) {
  const Eigen::Matrix3d m = rotation.normalized().toRotationMatrix();
  const double pitch = std::asin(std::clamp(-m(2, 0), -1.0, 1.0));
  if (std::abs(m(2, 0)) > 1 - 1e-12) return {std::atan2(-m(1, 2), m(1, 1)), pitch, 0};
  return {std::atan2(m(2, 1), m(2, 2)), pitch, std::atan2(m(1, 0), m(0, 0))};
}

void GripperVocabulary::check() const {
  if (!bounds) return;
  const Eigen::Vector3d extent = bounds->max() - bounds->min();
  if (!extent.allFinite() || (extent.array() <= 0).any()) {
    throw ArgumentError("GripperVocabulary: expected finite bounds with low below high on every axis");
  }
}

int GripperVocabulary::width() const {
  switch (rotation) {
    case RotationCode::kEuler: return 7;
    case RotationCode::kSinCos:
    case RotationCode::kMatrix6d: return 10;
    default: return 8;
  }
}

void GripperVocabulary::encode(const GripperPose& pose, std::vector<double>& values) const {
  Eigen::Vector3d position = pose.position;
  if (bounds) {
    const Eigen::Array3d unit = (position - bounds->min()).array() / (bounds->max() - bounds->min()).array();
    position = 2 * unit - 1;
  }
  values.insert(values.end(), position.begin(), position.end());
  const auto append = [&](std::initializer_list<double> numbers) { values.insert(values.end(), numbers); };

  Eigen::Quaterniond q = to_quaternion(pose.rpy);
  if (q.w() < 0) q.coeffs() *= -1;
  switch (rotation) {
    case RotationCode::kEuler: append({pose.rpy.x(), pose.rpy.y(), pose.rpy.z()}); break;
    case RotationCode::kSinCos:
      for (const double angle : pose.rpy) append({std::sin(angle), std::cos(angle)});
      break;
    case RotationCode::kMatrix6d: {
      const Eigen::Matrix3d m = q.toRotationMatrix();
      append({m(0, 0), m(1, 0), m(2, 0), m(0, 1), m(1, 1), m(2, 1)});
      break;
    }
    case RotationCode::kQuaternionWxyz: append({q.w(), q.x(), q.y(), q.z()}); break;
    case RotationCode::kQuaternionXyzw: append({q.x(), q.y(), q.z(), q.w()}); break;
  }
  values.push_back(pose.gripper);
}

}  // namespace wiw::action
