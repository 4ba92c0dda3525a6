// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <string>

#include "wiw/physics/articulation.hpp"

namespace wiw::physics {

/// What a joint may do, as JointLimits has it of all joints.
struct JointRange {
  double lower, upper, velocity, effort;
};

// What every reader of articulations asks of the numbers it reads. Both throw ArgumentError that begins with `owner`.

/// A mass of zero or more; finite, symmetric inertia without negative principal moments.
void check_inertial(const MassProperties& inertial, const std::string& owner);
/// lower <= upper, positive velocity and effort; infinite ones are no limits.
void check_range(const JointRange& range, const std::string& owner);

}  // namespace wiw::physics
