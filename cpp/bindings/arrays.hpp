// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <pybind11/numpy.h>

#include <Eigen/Geometry>
#include <initializer_list>
#include <string>
#include <vector>

#include "wiw/core/error.hpp"
#include "wiw/core/pose.hpp"

namespace wiw::bindings {

namespace py = pybind11;

/// C-contiguous input array; other layouts and dtypes are converted by NumPy.
template <class T>
using Array = py::array_t<T, py::array::c_style | py::array::forcecast>;

inline std::string shape_text(const py::array& array) {
  std::string text = "[";
  for (py::ssize_t i = 0; i < array.ndim(); ++i) text += (i ? ", " : "") + std::to_string(array.shape(i));
  return text + "] " + std::string(py::str(array.dtype()));
}

/// What was given in the place of an array: shape and dtype, or the type of what is none.
inline std::string given_text(const py::handle& value) {
  if (py::isinstance<py::array>(value)) return shape_text(py::reinterpret_borrow<py::array>(value));
  return py::str(py::type::of(value));
}

/// Throws ArgumentError unless the shape matches; -1 matches any length.
inline void expect_shape(const py::array& array, std::initializer_list<py::ssize_t> shape, const char* expected) {
  bool fits = array.ndim() == static_cast<py::ssize_t>(shape.size());
  py::ssize_t axis = 0;
  for (const py::ssize_t length : shape) {
    fits = fits && (length < 0 || array.shape(axis) == length);
    ++axis;
  }
  if (!fits) throw ArgumentError(std::string("expected ") + expected + ", got " + shape_text(array));
}

/// Integers of a Python value as an array of T. Throws ArgumentError for fractions and for numbers that T cannot hold,
/// which a plain cast would change silently.
template <class T>
Array<T> to_integers(const py::handle& value, const char* expected) {
  const auto given = py::array::ensure(value);
  if (!given) throw ArgumentError(std::string("expected ") + expected + ", got no array");
  if (given.size() > 0 && std::string("biu").find(given.dtype().kind()) == std::string::npos) {
    throw ArgumentError(std::string("expected ") + expected + ", got " + shape_text(given));
  }
  auto converted = Array<T>::ensure(given);
  if (given.dtype().is(converted.dtype())) return converted;
  const auto equal = py::module_::import("numpy").attr("array_equal")(given, converted);
  if (!equal.template cast<bool>()) {
    throw ArgumentError(std::string("expected ") + expected + ", got numbers out of its range");
  }
  return converted;
}

/// float64 [B, 4, 4] (or [4, 4]) rigid transforms; checks shape, finiteness and the rotation.
inline std::vector<Pose> to_poses(const Array<double>& matrices, const char* name) {
  const bool single = matrices.ndim() == 2;
  if (single) {
    expect_shape(matrices, {4, 4}, (std::string(name) + " [B, 4, 4]").c_str());
  } else {
    expect_shape(matrices, {-1, 4, 4}, (std::string(name) + " [B, 4, 4]").c_str());
  }
  const auto count = single ? 1 : static_cast<std::size_t>(matrices.shape(0));
  std::vector<Pose> poses(count);
  for (std::size_t i = 0; i < count; ++i) {
    const Eigen::Map<const Eigen::Matrix<double, 4, 4, Eigen::RowMajor>> matrix(matrices.data() + 16 * i);
    const Eigen::Matrix3d rotation = matrix.topLeftCorner<3, 3>();
    if (!matrix.allFinite() || !(rotation * rotation.transpose()).isIdentity(1e-4) || rotation.determinant() < 0 ||
        !matrix.row(3).isApprox(Eigen::RowVector4d(0, 0, 0, 1), 1e-9)) {
      throw ArgumentError(std::string(name) + "[" + std::to_string(i) +
                          "] is not a rigid transform (finite, orthonormal rotation, last row 0 0 0 1)");
    }
    poses[i].linear() = rotation;
    poses[i].translation() = matrix.topRightCorner<3, 1>();
  }
  return poses;
}

}  // namespace wiw::bindings
