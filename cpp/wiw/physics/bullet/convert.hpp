// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <LinearMath/btTransform.h>

#include "wiw/core/pose.hpp"

namespace wiw::physics {

inline btVector3 to_bullet(const Eigen::Vector3d& v) { return {v.x(), v.y(), v.z()}; }
inline Eigen::Vector3d to_eigen(const btVector3& v) { return {v.x(), v.y(), v.z()}; }

inline btMatrix3x3 to_bullet(const Eigen::Matrix3d& m) {
  return {m(0, 0), m(0, 1), m(0, 2), m(1, 0), m(1, 1), m(1, 2), m(2, 0), m(2, 1), m(2, 2)};
}
inline Eigen::Matrix3d to_eigen(const btMatrix3x3& m) {
  Eigen::Matrix3d result;
  for (int row = 0; row < 3; ++row) result.row(row) = to_eigen(m[row]).transpose();
  return result;
}

/// Both ways keep every bit.
inline btTransform to_bullet(const Pose& pose) {
  return btTransform(to_bullet(Eigen::Matrix3d(pose.linear())), to_bullet(Eigen::Vector3d(pose.translation())));
}
inline Pose to_eigen(const btTransform& transform) {
  Pose pose = Pose::Identity();
  pose.linear() = to_eigen(transform.getBasis());
  pose.translation() = to_eigen(transform.getOrigin());
  return pose;
}

}  // namespace wiw::physics
