// SPDX-License-Identifier: Apache-2.0
#include "wiw/action/trajectory.hpp"

#include <cmath>

namespace wiw::action {

std::vector<PlanarPose> to_trajectory(std::span<const Action> actions, const ActionSpace& space) {
  space.check();
  std::vector<PlanarPose> poses;
  poses.reserve(actions.size());
  PlanarPose pose;
  int turns = 0;  // whole turns, so that the azimuth of a long plan gathers no rounding error
  for (const Action action : actions) {
    turns += turn_sign(action);
    pose.azimuth = turns * space.turn_rad;
    if (action == Action::kForward) {
      pose.x += space.forward_m * std::cos(pose.azimuth);
      pose.y += space.forward_m * std::sin(pose.azimuth);
    }
    poses.push_back(pose);
  }
  return poses;
}

PlanarPose relative_to(const PlanarPose& start, const PlanarPose& pose) {
  const double c = std::cos(start.azimuth);
  const double s = std::sin(start.azimuth);
  const double dx = pose.x - start.x;
  const double dy = pose.y - start.y;
  return {c * dx + s * dy, -s * dx + c * dy, pose.azimuth - start.azimuth};
}

Pose to_viewpoint(const PlanarPose& pose) { return pose_from_yaw({-pose.y, 0, -pose.x}, pose.azimuth); }

}  // namespace wiw::action
