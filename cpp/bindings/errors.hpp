// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <pybind11/pybind11.h>

#include "wiw/core/error.hpp"
#include "wiw/core/utf8.hpp"

/// A Python exception for `Type`. Messages quote bytes of files; Python's text is UTF-8.
template <class Type>
pybind11::handle register_error(pybind11::module_& module, const char* name, const pybind11::handle& base) {
  namespace py = pybind11;
  static py::exception<Type>* exception = nullptr;  // Python's for as long as it runs: never freed
  exception = new py::exception<Type>(module, name, base);
  py::register_exception_translator([](std::exception_ptr pointer) {
    try {
      if (pointer) std::rethrow_exception(pointer);
    } catch (const Type& error) {
      PyErr_SetString(exception->ptr(), wiw::to_utf8(error.what()).c_str());
    }
  });
  return *exception;
}

/// Makes wiw::Error and its children Python exceptions; `wiw.errors` re-exports them.
inline void register_errors(pybind11::module_& module) {
  namespace py = pybind11;
  const auto errors = [](const py::handle& first, PyObject* second) {
    return py::reinterpret_steal<py::tuple>(PyTuple_Pack(2, first.ptr(), second));
  };
  const py::handle root = register_error<wiw::Error>(module, "Error", PyExc_Exception);
  register_error<wiw::ArgumentError>(module, "ArgumentError", errors(root, PyExc_ValueError));
  register_error<wiw::FileError>(module, "FileError", errors(root, PyExc_OSError));
  register_error<wiw::BackendError>(module, "BackendError", errors(root, PyExc_RuntimeError));
  register_error<wiw::NavigationError>(module, "NavigationError", root);
}
