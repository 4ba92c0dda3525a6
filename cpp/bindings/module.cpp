// SPDX-License-Identifier: Apache-2.0
#include <pybind11/pybind11.h>

#include "errors.hpp"

namespace py = pybind11;

#define ROOM(name) void bind_##name(py::module_& module);
#include "rooms.inc"
#undef ROOM

PYBIND11_MODULE(_core, module) {
  module.doc() = "Compiled core of wiw: one submodule a room. Use the faces in `wiw`, e.g. `wiw.panorama`.";
  register_errors(module);
#define ROOM(name)                                       \
  {                                                      \
    py::module_ submodule = module.def_submodule(#name); \
    bind_##name(submodule);                              \
  }
#include "rooms.inc"
#undef ROOM
}
