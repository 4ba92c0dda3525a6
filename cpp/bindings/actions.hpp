// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <pybind11/numpy.h>

#include <algorithm>
#include <span>
#include <vector>

#include "arrays.hpp"
#include "wiw/action/trajectory.hpp"

namespace wiw::bindings {

/// Checked action ids of any shape, flattened.
struct ActionArray {
  std::vector<action::Action> values;
  std::vector<py::ssize_t> shape;
};

inline bool is_integer(const py::array& array) {
  const char kind = array.dtype().kind();
  return kind == 'i' || kind == 'u';
}

inline ActionArray to_actions(const py::array& array) {
  if (!is_integer(array) && array.size() > 0) {
    throw ArgumentError("expected discrete action ids (integers), got " + shape_text(array));
  }
  const Array<std::int64_t> ids(array);
  ActionArray actions{.values = std::vector<action::Action>(static_cast<std::size_t>(ids.size())),
                      .shape = std::vector<py::ssize_t>(ids.shape(), ids.shape() + ids.ndim())};
  std::transform(ids.data(), ids.data() + ids.size(), actions.values.begin(),
                 [](std::int64_t id) { return action::to_action(id); });
  return actions;
}

/// An array, or what NumPy makes of a sequence.
inline py::array to_array(const py::handle& object) {
  const py::array array = py::array::ensure(py::reinterpret_borrow<py::object>(object));
  if (!array) throw ArgumentError("expected a plan of action ids [K], got " + std::string(py::repr(object)));
  return array;
}

/// One plan: ids of shape [K].
inline std::vector<action::Action> to_plan(const py::array& array) {
  ActionArray actions = to_actions(array);
  if (actions.shape.size() != 1) throw ArgumentError("expected one plan of action ids [K], got " + shape_text(array));
  return std::move(actions.values);
}

inline py::array_t<std::int8_t> to_ids(std::span<const action::Action> actions) {
  py::array_t<std::int8_t> ids(static_cast<py::ssize_t>(actions.size()));
  std::transform(actions.begin(), actions.end(), ids.mutable_data(),
                 [](action::Action a) { return static_cast<std::int8_t>(a); });
  return ids;
}

/// float64 [K, 3].
inline py::array_t<double> planar_array(std::span<const action::PlanarPose> poses) {
  py::array_t<double> array({static_cast<py::ssize_t>(poses.size()), py::ssize_t{3}});
  double* out = array.mutable_data();
  for (const action::PlanarPose& pose : poses) {
    *out++ = pose.x;
    *out++ = pose.y;
    *out++ = pose.azimuth;
  }
  return array;
}

/// float64 [K, 4, 4].
inline py::array_t<double> matrix_array(std::span<const Pose> poses) {
  py::array_t<double> array({static_cast<py::ssize_t>(poses.size()), py::ssize_t{4}, py::ssize_t{4}});
  double* out = array.mutable_data();
  for (const Pose& pose : poses) {
    Eigen::Map<Eigen::Matrix<double, 4, 4, Eigen::RowMajor>> matrix(out);
    matrix = pose.matrix();
    out += 16;
  }
  return array;
}

}  // namespace wiw::bindings
