// SPDX-License-Identifier: Apache-2.0
#include "wiw/env/navigation_env.hpp"

#include <sstream>

#include "wiw/core/error.hpp"

namespace wiw {

namespace {

double wrapped(double angle) { return std::remainder(angle, 2 * kPi); }

std::string text_of(const Eigen::Vector3d& point) {
  std::ostringstream text;
  text << "(" << point.x() << ", " << point.y() << ", " << point.z() << ")";
  return text.str();
}

}  // namespace

NavigationEnv::NavigationEnv(World world, const NavigationConfig& config) : world_(std::move(world)), config_(config) {
  config_.actions.check();
  if (world_.renderer == nullptr || world_.navmesh == nullptr) {
    throw ArgumentError("NavigationEnv: expected a renderer and a navigation mesh");
  }
}

void NavigationEnv::reset(const Eigen::Vector3d& position, double yaw, double tolerance) {
  const auto snapped = world_.navmesh->snap(position.cast<float>());
  if (!snapped || (snapped->cast<double>() - position).norm() > tolerance) {
    throw NavigationError(
        "NavigationEnv.reset: " + text_of(position) + " is not on the navigation mesh (nearest point " +
        (snapped ? text_of(snapped->cast<double>()) : "none") + ", tolerance " + std::to_string(tolerance) + " m)");
  }
  position_ = start_position_ = snapped->cast<double>();
  start_yaw_ = yaw;
  turns_ = 0;
}

bool NavigationEnv::step(Action action) {
  if (const int sign = turn_sign(action); sign != 0) {
    turns_ += sign;
    if (const int circle = config_.actions.turns_per_circle(); circle != 0) turns_ %= circle;
    return true;
  }
  if (action != Action::kForward) return false;
  const Eigen::Vector3d heading(-std::sin(yaw()), 0, -std::cos(yaw()));
  const Eigen::Vector3d end = position_ + config_.actions.forward_m * heading;
  const Eigen::Vector3d before = position_;
  if (config_.motion == Motion::kSlide) {
    position_ = world_.navmesh->try_step(position_.cast<float>(), end.cast<float>(), true).cast<double>();
  } else if (world_.navmesh->is_navigable(end.cast<float>())) {
    if (const auto snapped = world_.navmesh->snap(end.cast<float>())) position_ = snapped->cast<double>();
  }
  return position_ != before;
}

double NavigationEnv::yaw() const { return start_yaw_ + turns_ * config_.actions.turn_rad; }

Pose NavigationEnv::T_world_camera() const {
  return pose_from_yaw(position_ + Eigen::Vector3d(0, config_.camera_height, 0), yaw());
}

Eigen::Vector3d NavigationEnv::odometry() const {
  const Eigen::Vector3d moved =
      Eigen::AngleAxisd(-start_yaw_, Eigen::Vector3d::UnitY()) * (position_ - start_position_);
  return {-moved.z(), -moved.x(), wrapped(turns_ * config_.actions.turn_rad)};
}

std::vector<Pose> NavigationEnv::camera_poses_after(std::span<const Action> actions) const {
  NavigationEnv fork = *this;
  std::vector<Pose> poses;
  poses.reserve(actions.size());
  for (const Action action : actions) {
    fork.step(action);
    poses.push_back(fork.T_world_camera());
  }
  return poses;
}

void NavigationEnv::observe(const ObservationTargets& targets) const { wiw::observe({this, 1}, targets); }

void observe(std::span<const NavigationEnv> envs, const ObservationTargets& targets) {
  if (envs.empty()) return;
  std::vector<Pose> poses;
  poses.reserve(envs.size());
  for (const NavigationEnv& env : envs) poses.push_back(env.T_world_camera());
  const NavigationConfig& config = envs[0].config();
  Renderer& renderer = *envs[0].world().renderer;
  if (targets.panorama != nullptr || targets.depth != nullptr) {
    renderer.render(poses, {.projection = Projection::kEquirectangular, .size = config.panorama},
                    {.color = targets.panorama, .depth = targets.depth});
  }
  if (targets.front != nullptr) {
    renderer.render(poses, {.size = config.front, .hfov = config.front_hfov}, {.color = targets.front});
  }
}

}  // namespace wiw
