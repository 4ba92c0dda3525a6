// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <pybind11/pybind11.h>

#include "wiw/physics/articulation.hpp"

namespace wiw::bindings {

/// An articulation as plain data: dicts, lists, numbers and texts, which JSON can hold to the last bit.
pybind11::dict articulation_to_parts(const physics::Articulation& articulation);

/// The articulation that `articulation_to_parts` was given. Throws ArgumentError for parts that do not fit each
/// other and for impossible numbers.
physics::ArticulationPtr articulation_from_parts(const pybind11::dict& parts);

}  // namespace wiw::bindings
