// SPDX-License-Identifier: Apache-2.0
#include "wiw/env/navigation_env.hpp"

#include <sstream>

#include "wiw/core/error.hpp"

namespace wiw::env {

namespace {

constexpr double kMaxLift = 0.5;  // metres that a floor and the mesh built on it may be apart

double wrapped(double angle) { return std::remainder(angle, 2 * kPi); }

std::string text_of(const Eigen::Vector3d& point) {
  std::ostringstream text;
  text << "(" << point.x() << ", " << point.y() << ", " << point.z() << ")";
  return text.str();
}

}  // namespace

NavigationEnv::NavigationEnv(NavigationWorld world, const NavigationConfig& config)
    : world_(std::move(world)), config_(config) {
  config_.actions.check();
  if (world_.renderer == nullptr || world_.navmesh == nullptr || world_.ground == nullptr) {
    throw ArgumentError("NavigationEnv: expected a renderer, a navigation mesh and a ground");
  }
}

void NavigationEnv::reset(const Eigen::Vector3d& position, double yaw, double tolerance) {
  if (!position.allFinite() || !std::isfinite(yaw) || !std::isfinite(tolerance)) {
    throw ArgumentError("NavigationEnv.reset: expected finite numbers, got position " + text_of(position) + ", yaw " +
                        std::to_string(yaw) + ", tolerance " + std::to_string(tolerance));
  }
  const auto snapped = world_.navmesh->snap(position.cast<float>());
  const Eigen::Vector3d away = snapped ? Eigen::Vector3d(snapped->cast<double>() - position) : Eigen::Vector3d::Zero();
  const double beside = std::hypot(away.x(), away.z());
  if (!snapped || beside > tolerance || std::abs(away.y()) > kMaxLift) {
    std::ostringstream text;
    text << "NavigationEnv.reset: " << text_of(position) << " is not on the navigation mesh: expected a point of it at "
         << "most " << tolerance << " m beside and " << kMaxLift << " m above or below; ";
    if (snapped) {
      text << "the nearest, " << text_of(snapped->cast<double>()) << ", is " << beside << " m beside and "
           << std::abs(away.y()) << " m " << (away.y() > 0 ? "above" : "below");
    } else {
      text << "there is none near it";
    }
    throw NavigationError(text.str());
  }
  stand_at(*snapped);
  start_position_ = position_;
  start_yaw_ = yaw;
  turns_ = 0;
}

bool NavigationEnv::step(action::Action action) {
  if (const int sign = action::turn_sign(action); sign != 0) {
    turns_ += sign;
    if (const int circle = config_.actions.turns_per_circle(); circle != 0) turns_ %= circle;
    return true;
  }
  if (action != action::Action::kForward) return false;
  const Eigen::Vector3d heading(-std::sin(yaw()), 0, -std::cos(yaw()));
  const Eigen::Vector3d end = on_mesh_ + config_.actions.forward_m * heading;
  const Eigen::Vector3d before = on_mesh_;
  if (config_.motion == Motion::kSlide) {
    stand_at(world_.navmesh->try_step(on_mesh_.cast<float>(), end.cast<float>(), true));
  } else if (world_.navmesh->is_navigable(end.cast<float>())) {
    if (const auto snapped = world_.navmesh->snap(end.cast<float>())) stand_at(*snapped);
  }
  return on_mesh_ != before;
}

void NavigationEnv::stand_at(const Eigen::Vector3f& on_mesh) {
  on_mesh_ = position_ = on_mesh.cast<double>();
  position_.y() = world_.ground->height(on_mesh_);
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

std::vector<Pose> NavigationEnv::camera_poses_after(std::span<const action::Action> actions) const {
  NavigationEnv fork = *this;
  std::vector<Pose> poses;
  poses.reserve(actions.size());
  for (const action::Action action : actions) {
    fork.step(action);
    poses.push_back(fork.T_world_camera());
  }
  return poses;
}

void NavigationEnv::observe(const ObservationTargets& targets) const { env::observe({this, 1}, targets); }

void observe(std::span<const NavigationEnv> envs, const ObservationTargets& targets) {
  if (envs.empty()) return;
  std::vector<Pose> poses;
  poses.reserve(envs.size());
  for (const NavigationEnv& env : envs) poses.push_back(env.T_world_camera());
  const NavigationConfig& config = envs[0].config();
  render::Renderer& renderer = *envs[0].world().renderer;
  if (targets.panorama != nullptr || targets.depth != nullptr || targets.panorama_ids != nullptr) {
    renderer.render(poses, {.projection = render::Projection::kEquirectangular, .size = config.panorama},
                    {.color = targets.panorama, .depth = targets.depth, .instance = targets.panorama_ids});
  }
  if (targets.front != nullptr || targets.front_ids != nullptr) {
    renderer.render(poses, {.size = config.front, .hfov = config.front_hfov},
                    {.color = targets.front, .instance = targets.front_ids});
  }
}

}  // namespace wiw::env
