// SPDX-License-Identifier: Apache-2.0
#include "wiw/physics/linear_path.hpp"

#include <cmath>

#include "wiw/core/error.hpp"

namespace wiw::physics {

namespace {

PathReason to_path_reason(IkReason reason) {
  switch (reason) {
    case IkReason::kReached: return PathReason::kFree;
    case IkReason::kOutOfReach: return PathReason::kOutOfReach;
    case IkReason::kJointLimits: return PathReason::kJointLimits;
    case IkReason::kNotConverged: break;
  }
  return PathReason::kNotConverged;
}

Pose between(const Pose& from, const Pose& to, double share) {
  Pose pose = Pose::Identity();
  pose.linear() = Eigen::Quaterniond(from.linear()).slerp(share, Eigen::Quaterniond(to.linear())).toRotationMatrix();
  pose.translation() = (1 - share) * from.translation() + share * to.translation();
  return pose;
}

constexpr double kMostSegments = 1e6;
constexpr double kMostSteps = 1e6;  // of time, from one waypoint to the next

int segments(const Pose& from, const Pose& to, const LinearPathOptions& options) {
  if (!(options.step > 0) || !(options.angle_step > 0) || !(options.tolerance >= 0)) {
    throw ArgumentError("expected a positive step and angle_step of the path, and a tolerance of 0 or more, got step=" +
                        std::to_string(options.step) + ", angle_step=" + std::to_string(options.angle_step) +
                        ", tolerance=" + std::to_string(options.tolerance));
  }
  const double length = (to.translation() - from.translation()).norm();
  const double angle = Eigen::Quaterniond(from.linear()).angularDistance(Eigen::Quaterniond(to.linear()));
  const double count = std::ceil(std::max(length / options.step, angle / options.angle_step) - 1e-9);
  if (count > kMostSegments)
    throw ArgumentError("expected a path of at most a million waypoints; make its steps longer");
  return std::max(1, static_cast<int>(count));
}

/// Time steps to each waypoint but the first, by the joints' velocity limits at a share `speed` of them.
std::vector<int> count_steps(const World& world, int articulation, const LinearPath& path, double speed) {
  const Articulation& robot = *world.articulation(articulation);
  const double reach = speed * world.options().time_step;
  std::vector<int> steps;
  for (std::size_t i = 1; i < path.joints.size(); ++i) {
    const Eigen::VectorXd way = path.joints[i] - path.joints[i - 1];
    double longest = 1;
    for (const int joint : path.moved) {
      const double count = std::abs(way[joint]) / (reach * robot.limits().velocity[joint]);
      if (count > kMostSteps) {
        throw ArgumentError("expected a path of at most a million time steps from one waypoint to the next; joint '" +
                            robot.movable_joints()[static_cast<std::size_t>(joint)] +
                            "' would take more; raise its velocity limit or the speed");
      }
      longest = std::max(longest, count);
    }
    steps.push_back(static_cast<int>(std::ceil(longest)));
  }
  return steps;
}

}  // namespace

const char* reason_text(PathReason reason) {
  switch (reason) {
    case PathReason::kFree: return "free";
    case PathReason::kOutOfReach: return "out of reach";
    case PathReason::kJointLimits: return "joint limits";
    case PathReason::kNotConverged: return "not converged";
    case PathReason::kJump: return "jump";
    case PathReason::kCollision: return "collision";
  }
  return "";
}

double LinearPath::free() const {
  return joints.empty() ? 0 : static_cast<double>(joints.size() - 1) / static_cast<double>(waypoints - 1);
}

LinearPath plan_linear(World& world, int articulation, int link, const Pose& T_world_link, const Touchable& allowed,
                       const LinearPathOptions& options) {
  check_pose(T_world_link, "T_world_link");
  const InverseKinematics ik(world.articulation(articulation), link);
  const Pose to_base = world.base_pose(articulation).inverse();
  const Pose from = to_base * world.link_poses(articulation).at(static_cast<std::size_t>(link));
  const Pose to = to_base * T_world_link;
  const int count = segments(from, to, options);
  IkOptions near = options.ik;
  near.restarts = 0;
  const JointLimits& limits = world.articulation(articulation)->limits();
  // A motor that pushes against a limit leaves its joint some millionths beyond, where no target may be.
  const Eigen::VectorXd start = world.joint_positions(articulation).cwiseMax(limits.lower).cwiseMin(limits.upper);
  LinearPath path{.joints = {start}, .moved = ik.joints(), .waypoints = count + 1};
  for (int i = 1; i <= count; ++i) {
    const IkResult next = ik.solve(between(from, to, static_cast<double>(i) / count), path.joints.back(), near);
    path.reason = to_path_reason(next.reason);
    if (next.reached() && (next.joints - path.joints.back()).cwiseAbs().maxCoeff() > options.longest_jump) {
      path.reason = PathReason::kJump;
    }
    if (path.reason != PathReason::kFree) break;
    path.joints.push_back(next.joints);
  }
  if (const auto hit = world.first_collision(articulation, path.joints, allowed, options.tolerance)) {
    path.reason = PathReason::kCollision;
    path.contact = hit->contact;
    path.joints.resize(static_cast<std::size_t>(hit->waypoint));
  }
  return path;
}

bool follow(World& world, int articulation, const LinearPath& path, double speed, double tolerance, int settle) {
  if (!(speed > 0 && speed <= 1)) throw ArgumentError("expected a speed in (0, 1], got " + std::to_string(speed));
  if (!(tolerance > 0)) throw ArgumentError("expected a positive tolerance, got " + std::to_string(tolerance));
  if (path.joints.empty()) return false;
  for (const Eigen::VectorXd& each : path.joints) world.articulation(articulation)->check_positions(each, "path");
  const std::vector<int> counts = count_steps(world, articulation, path, speed);
  Eigen::VectorXd target = world.joint_targets(articulation);
  for (std::size_t i = 1; i < path.joints.size(); ++i) {
    const Eigen::VectorXd way = path.joints[i] - path.joints[i - 1];
    const int steps = counts[i - 1];
    for (int step = 1; step <= steps; ++step) {
      for (const int joint : path.moved) target[joint] = path.joints[i - 1][joint] + way[joint] * step / steps;
      world.set_joint_targets(articulation, target);
      world.step();
    }
  }
  const auto arrived = [&] {
    const Eigen::VectorXd left = path.joints.back() - world.joint_positions(articulation);
    return std::all_of(path.moved.begin(), path.moved.end(), [&](int j) { return std::abs(left[j]) <= tolerance; });
  };
  for (int i = 0; i < settle && !arrived(); ++i) world.step();
  return arrived();
}

}  // namespace wiw::physics
