// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <optional>
#include <vector>

#include "wiw/physics/inverse_kinematics.hpp"
#include "wiw/physics/world.hpp"

namespace wiw::physics {

struct LinearPathOptions {
  double step = 0.005;         // metres between waypoints, at most
  double angle_step = 0.035;   // radians between waypoints, at most
  double longest_jump = 0.25;  // radians or metres that a joint may move from one waypoint to the next
  double tolerance = 1e-3;     // metres of overlap that count as touching
  IkOptions ik;
};

enum class PathReason { kFree, kOutOfReach, kJointLimits, kNotConverged, kJump, kCollision };
const char* reason_text(PathReason reason);

/// A straight path of a link, position and rotation interpolated together. Waypoint 0 is the start.
struct LinearPath {
  PathReason reason = PathReason::kFree;
  std::vector<Eigen::VectorXd> joints;  // of the waypoints that are reached without a collision
  std::vector<int> moved;               // joints of the chain; the others stay where they are
  int waypoints = 0;                    // of the whole way
  std::optional<Contact> contact;       // what is touched first
  /// Free share of the path, in [0, 1].
  [[nodiscard]] double free() const;
};

/// Straight from where the link is to `T_world_link`: inverse kinematics from waypoint to waypoint without restarts,
/// then a check of the arm, and of what it holds, against everything but what is `allowed` (`World::first_collision`).
/// The state stays as it is.
LinearPath plan_linear(World& world, int articulation, int link, const Pose& T_world_link,
                       const Touchable& allowed = {}, const LinearPathOptions& options = {});

/// Drives the moved joints along the path at `speed` times their velocity limits (in (0, 1]), then waits until they
/// stand within `tolerance` of the end, at most `settle` steps. Returns whether they do. Throws ArgumentError and
/// moves nothing where a joint would take more than a million steps from one waypoint to the next.
bool follow(World& world, int articulation, const LinearPath& path, double speed = 0.5, double tolerance = 1e-3,
            int settle = 240);

}  // namespace wiw::physics
