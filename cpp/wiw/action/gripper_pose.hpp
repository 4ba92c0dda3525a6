// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <Eigen/Geometry>
#include <optional>
#include <vector>

namespace wiw::action {

/// Continuous 7-DoF action: where the end effector shall be. Rotation is Rz(yaw) Ry(pitch) Rx(roll), radians;
/// gripper 1 is open, 0 is closed.
struct GripperPose {
  Eigen::Vector3d position = Eigen::Vector3d::Zero();
  Eigen::Vector3d rpy = Eigen::Vector3d::Zero();
  double gripper = 1;
};

Eigen::Quaterniond to_quaternion(const Eigen::Vector3d& rpy);

/// Inverse of to_quaternion with pitch in [-pi/2, pi/2]; at the poles, where only roll minus yaw (or plus) is
/// determined, yaw is 0.
Eigen::Vector3d to_rpy(const Eigen::Quaterniond& rotation);

/// How a model wants a rotation as numbers: 3 angles, 6 sines and cosines, the first two columns of the matrix, or a
/// quaternion in either order (with w >= 0).
enum class RotationCode { kEuler, kSinCos, kMatrix6d, kQuaternionWxyz, kQuaternionXyzw };

/// A model's vocabulary for continuous actions: [position, rotation, gripper]. With bounds, position is mapped to
/// [-1, 1] over them.
struct GripperVocabulary {
  RotationCode rotation = RotationCode::kEuler;
  std::optional<Eigen::AlignedBox3d> bounds;

  /// Throws ArgumentError if the bounds are empty or not finite.
  void check() const;
  [[nodiscard]] int width() const;
  /// Appends `width()` numbers.
  void encode(const GripperPose& pose, std::vector<double>& values) const;
};

}  // namespace wiw::action
