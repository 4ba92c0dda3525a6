// SPDX-License-Identifier: Apache-2.0
#pragma once

#include "wiw/core/pose.hpp"

namespace wiw::metrics {

struct PoseError {
  double translation_m = 0;
  double rotation_rad = 0;  // angle of the rotation between the two, in [0, pi]
};

PoseError pose_error(const Pose& a, const Pose& b);

}  // namespace wiw::metrics
