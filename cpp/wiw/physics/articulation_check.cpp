// SPDX-License-Identifier: Apache-2.0
#include "wiw/physics/articulation_check.hpp"

#include <cmath>

#include "wiw/core/error.hpp"

namespace wiw::physics {

void check_inertial(const MassProperties& inertial, const std::string& owner) {
  const bool finite = std::isfinite(inertial.mass) && inertial.center.allFinite() && inertial.inertia.allFinite();
  if (!finite || inertial.mass < 0) {
    throw ArgumentError(owner + ": expected a mass of zero or more, a finite centre and finite inertia, got mass " +
                        std::to_string(inertial.mass));
  }
  if (!inertial.inertia.isApprox(inertial.inertia.transpose(), 1e-6)) {
    throw ArgumentError(owner + ": expected a symmetric inertia");
  }
  if (principal_frame(inertial).moments.minCoeff() < -1e-9) {
    throw ArgumentError(owner + ": the inertia has a negative principal moment");
  }
}

void check_range(const JointRange& range, const std::string& owner) {
  if (range.lower <= range.upper && range.velocity > 0 && range.effort > 0) return;  // false for NaN
  throw ArgumentError(owner + " are impossible; expected lower <= upper, positive velocity and effort");
}

}  // namespace wiw::physics
