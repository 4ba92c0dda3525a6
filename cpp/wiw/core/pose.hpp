// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <Eigen/Geometry>

namespace wiw {

/// Rigid transform. Named T_to_from: `T_world_camera` maps camera coordinates to world coordinates.
/// World: metres, Y up, right-handed; a camera looks down -Z with +X to its right; yaw is positive to the left.
using Pose = Eigen::Isometry3d;

/// Pose at `position` that looks along -Z turned left by `yaw` radians about +Y.
inline Pose pose_from_yaw(const Eigen::Vector3d& position, double yaw) {
  Pose pose = Pose::Identity();
  pose.linear() = Eigen::AngleAxisd(yaw, Eigen::Vector3d::UnitY()).toRotationMatrix();
  pose.translation() = position;
  return pose;
}

/// Heading of a pose in (-pi, pi]: 0 looks along -Z, positive to the left. Pitch is ignored.
inline double yaw_of(const Pose& pose) {
  const Eigen::Vector3d forward = -pose.linear().col(2);
  return std::atan2(-forward.x(), -forward.z());
}

}  // namespace wiw
