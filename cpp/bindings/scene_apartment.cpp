// SPDX-License-Identifier: Apache-2.0
#include <pybind11/pybind11.h>
#include <pybind11/stl.h>

#include "wiw/apartment/apartment.hpp"

namespace py = pybind11;

void bind_apartment(py::module_& module) {
  module.def(
      "apartment",
      [](std::uint64_t seed, const std::string& split) {
        const wiw::apartment::Split part = wiw::apartment::split_from_name(split);
        const py::gil_scoped_release release;
        return std::make_shared<wiw::scene::Scene>(wiw::apartment::make_apartment(seed, part));
      },
      py::arg("seed"), py::arg("split"), "Furnished apartment with baked light, a function of seed and split.");
  module.def(
      "apartment_identity",
      [](std::uint64_t seed, const std::string& split) {
        const wiw::apartment::ApartmentIdentity identity =
            wiw::apartment::apartment_identity(seed, wiw::apartment::split_from_name(split));
        return py::make_tuple(identity.layout, identity.palette);
      },
      py::arg("seed"), py::arg("split"), "(signature of the floor plan, sorted palette) without building the scene.");
}
