// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <memory>
#include <span>
#include <vector>

#include "wiw/action/action.hpp"
#include "wiw/nav/ground.hpp"
#include "wiw/nav/nav_mesh.hpp"
#include "wiw/render/renderer.hpp"

namespace wiw::env {

/// What happens to a forward step whose end is not navigable.
enum class Motion {
  kRefuse,  // the agent stays where it is; the step counts (the paper's environment)
  kSlide,   // the agent slides along the obstacle (Habitat's default)
};

struct NavigationConfig {
  action::ActionSpace actions;
  Motion motion = Motion::kRefuse;
  double camera_height = 1.0;  // metres above the floor that is drawn
  Size panorama{576, 1024};
  Size front{480, 480};
  double front_hfov = radians(90);
};

/// A scene with what is needed to see it and to walk in it; shared by all environments in that scene.
struct NavigationWorld {
  std::shared_ptr<render::Renderer> renderer;
  std::shared_ptr<const nav::NavMesh> navmesh;
  std::shared_ptr<const nav::Ground> ground;
};

/// Where one observation is written; null members are not rendered.
struct ObservationTargets {
  std::uint8_t* panorama = nullptr;       // [H, W, 3]
  std::uint8_t* front = nullptr;          // [h, w, 3]
  float* depth = nullptr;                 // [H, W] of the panorama, distance along the ray
  std::uint32_t* panorama_ids = nullptr;  // [H, W] Instance::id of what each pixel shows, 0 where nothing is hit
  std::uint32_t* front_ids = nullptr;     // [h, w]
};

/// A point agent with a heading on a navigation mesh. Copying it forks the simulation: copies share the world, which
/// no agent changes. Headings are whole turns from the start heading, so that 16 turns of 22.5 degrees are a circle
/// to the last bit.
class NavigationEnv {
 public:
  NavigationEnv(NavigationWorld world, const NavigationConfig& config);

  /// Puts the agent on the mesh. Throws NavigationError when `position` is more than `tolerance` metres beside it or
  /// more than kMaxLift above or below, ArgumentError when a number is not finite.
  void reset(const Eigen::Vector3d& position, double yaw, double tolerance = 0.3);

  /// Carries out one primitive; true if the pose changed. kNull and kStop change nothing.
  bool step(action::Action action);

  /// Where the agent stands, on the floor.
  [[nodiscard]] const Eigen::Vector3d& position() const { return position_; }
  [[nodiscard]] double yaw() const;
  [[nodiscard]] Pose T_world_camera() const;

  /// Pose of the agent in the frame of its reset: x forward, y left (metres), azimuth (radians, left positive,
  /// in [-pi, pi]).
  [[nodiscard]] Eigen::Vector3d odometry() const;

  /// Camera poses after each of `actions`, carried out by a fork; this environment stays as it is.
  [[nodiscard]] std::vector<Pose> camera_poses_after(std::span<const action::Action> actions) const;

  void observe(const ObservationTargets& targets) const;

  [[nodiscard]] const NavigationWorld& world() const { return world_; }
  [[nodiscard]] const NavigationConfig& config() const { return config_; }

 private:
  void stand_at(const Eigen::Vector3f& on_mesh);

  NavigationWorld world_;
  NavigationConfig config_;
  Eigen::Vector3d on_mesh_ = Eigen::Vector3d::Zero();   // the point that walks: Recast's heights, above the floor
  Eigen::Vector3d position_ = Eigen::Vector3d::Zero();  // the same on the floor
  Eigen::Vector3d start_position_ = Eigen::Vector3d::Zero();
  double start_yaw_ = 0;
  int turns_ = 0;  // left positive, since reset
};

/// Observations of several agents in one scene, rendered as one batch: members of `targets` are [N, ...].
void observe(std::span<const NavigationEnv> envs, const ObservationTargets& targets);

}  // namespace wiw::env
