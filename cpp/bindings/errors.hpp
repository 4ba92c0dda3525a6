// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <pybind11/pybind11.h>

#include "wiw/core/error.hpp"

/// Makes wiw::Error and its children Python exceptions; `wiw.errors` re-exports them.
inline void register_errors(pybind11::module_& module) {
  namespace py = pybind11;
  const auto errors = [](PyObject* first, PyObject* second) {
    return py::reinterpret_steal<py::tuple>(PyTuple_Pack(2, first, second));
  };
  auto& root = py::register_exception<wiw::Error>(module, "Error");
  py::register_exception<wiw::ArgumentError>(module, "ArgumentError", errors(root.ptr(), PyExc_ValueError));
  py::register_exception<wiw::FileError>(module, "FileError", errors(root.ptr(), PyExc_OSError));
  py::register_exception<wiw::BackendError>(module, "BackendError", errors(root.ptr(), PyExc_RuntimeError));
  py::register_exception<wiw::NavigationError>(module, "NavigationError", root.ptr());
}
