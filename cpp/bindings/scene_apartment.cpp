// SPDX-License-Identifier: Apache-2.0
#include <pybind11/pybind11.h>
#include <pybind11/stl.h>

#include <string>
#include <vector>

#include "gil.hpp"
#include "wiw/apartment/apartment.hpp"
#include "wiw/apartment/edits.hpp"

namespace py = pybind11;
namespace apartment = wiw::apartment;

using Texts = std::vector<std::string>;

void bind_apartment(py::module_& module) {
  module.def(
      "apartment",
      [](std::uint64_t seed, const std::string& split, const Texts& edits) {
        const apartment::Split part = apartment::split_from_name(split);
        const wiw::bindings::GilRelease release;
        return std::make_shared<wiw::scene::Scene>(
            apartment::make_apartment(seed, part, apartment::parse_edits(edits)));
      },
      py::arg("seed"), py::arg("split"), py::arg("edits") = Texts{},
      "Furnished apartment with baked light, a function of seed, split and edits.");
  module.def(
      "apartment_outline",
      [](std::uint64_t seed, const std::string& split, const Texts& edits) {
        const apartment::Split part = apartment::split_from_name(split);
        const wiw::bindings::GilRelease release;
        return std::make_shared<wiw::scene::Scene>(
            apartment::outline_apartment(seed, part, apartment::parse_edits(edits)));
      },
      py::arg("seed"), py::arg("split"), py::arg("edits") = Texts{},
      "The same rooms and instances without textures and light.");
  module.def(
      "possible_edits",
      [](std::uint64_t seed, const std::string& split, const Texts& edits) {
        const apartment::Split part = apartment::split_from_name(split);
        const wiw::bindings::GilRelease release;
        Texts texts;
        for (const apartment::Edit& edit : apartment::possible_edits(seed, part, apartment::parse_edits(edits)))
          texts.push_back(apartment::to_text(edit));
        return texts;
      },
      py::arg("seed"), py::arg("split"), py::arg("edits") = Texts{},
      "Edits that the apartment with `edits` can have as well.");
  module.def(
      "canonical_edits",
      [](const Texts& edits) {
        Texts texts;
        for (const apartment::Edit& edit : apartment::parse_edits(edits)) texts.push_back(apartment::to_text(edit));
        return texts;
      },
      py::arg("edits"), "The same edits in one order and spelling. Raises ArgumentError where one is none.");
  module.def("color_names", [] { return apartment::color_names(); }, "Names of colours, sorted.");
  module.def(
      "apartment_identity",
      [](std::uint64_t seed, const std::string& split) {
        const wiw::apartment::ApartmentIdentity identity =
            wiw::apartment::apartment_identity(seed, wiw::apartment::split_from_name(split));
        return py::make_tuple(identity.layout, identity.palette);
      },
      py::arg("seed"), py::arg("split"), "(signature of the floor plan, sorted palette) without building the scene.");
}
