// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <stdexcept>
#include <string>

namespace wiw {

/// Root of every error the core throws. Each message says what was expected, what came, and what to do.
/// The bindings translate each class to the Python exception of the same name in `wiw.errors`.
class Error : public std::runtime_error {
  using std::runtime_error::runtime_error;
};

/// An argument is out of its documented range or shape. Also a ValueError in Python.
class ArgumentError : public Error {
  using Error::Error;
};

/// A file is missing, damaged, unsupported or larger than the limits. The message names file and cause.
class FileError : public Error {
 public:
  FileError(const std::string& path, const std::string& cause) : Error(path + ": " + cause) {}
};

/// This machine lacks what was asked for (an EGL device, an instruction set). The message names the remedy.
class BackendError : public Error {
  using Error::Error;
};

/// A navigation query has no answer: a point is off the mesh, or start and end lie on different islands.
class NavigationError : public Error {
  using Error::Error;
};

}  // namespace wiw
