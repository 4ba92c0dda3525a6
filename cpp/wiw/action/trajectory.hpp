// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <span>
#include <vector>

#include "wiw/action/action.hpp"
#include "wiw/core/pose.hpp"

namespace wiw::action {

/// Pose on the floor, relative to where a plan starts: x metres forward, y metres left, azimuth radians to the left.
/// The azimuth counts full circles (sixteen left turns give 2 pi), so that it can be interpolated.
struct PlanarPose {
  double x = 0;
  double y = 0;
  double azimuth = 0;
};

/// The pose after each action, in the frame of the start.
std::vector<PlanarPose> to_trajectory(std::span<const Action> actions, const ActionSpace& space);

/// `pose` seen from `start`: both given in one frame, the result in the frame of `start`.
PlanarPose relative_to(const PlanarPose& start, const PlanarPose& pose);

/// Camera pose T_start_camera in the camera convention (right +X, up +Y, looks down -Z).
Pose to_viewpoint(const PlanarPose& pose);

}  // namespace wiw::action
