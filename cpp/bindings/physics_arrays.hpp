// SPDX-License-Identifier: Apache-2.0
#pragma once

#include "arrays.hpp"

namespace wiw::bindings {

inline void copy_pose(const Pose& pose, double* out) {
  Eigen::Map<Eigen::Matrix<double, 4, 4, Eigen::RowMajor>> matrix(out);
  matrix = pose.matrix();
}

/// float64 [4, 4].
inline py::array_t<double> pose_array(const Pose& pose) {
  py::array_t<double> array({py::ssize_t{4}, py::ssize_t{4}});
  copy_pose(pose, array.mutable_data());
  return array;
}

/// float64 [N, 4, 4].
inline py::array_t<double> pose_array(const std::vector<Pose>& poses) {
  py::array_t<double> array({static_cast<py::ssize_t>(poses.size()), py::ssize_t{4}, py::ssize_t{4}});
  double* out = array.mutable_data();
  for (const Pose& pose : poses) {
    copy_pose(pose, out);
    out += 16;
  }
  return array;
}

inline Pose to_pose(const Array<double>& matrix, const char* name) {
  if (matrix.ndim() != 2) throw ArgumentError(std::string("expected ") + name + " [4, 4], got " + shape_text(matrix));
  return to_poses(matrix, name)[0];
}

}  // namespace wiw::bindings
