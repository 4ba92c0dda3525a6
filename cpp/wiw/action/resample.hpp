// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstddef>
#include <optional>
#include <span>
#include <vector>

#include "wiw/action/gripper_pose.hpp"
#include "wiw/action/trajectory.hpp"

namespace wiw::action {

/// When the gripper changes between two waypoints: on reaching the second, or half-way.
enum class GripperRule { kStep, kNearest };

/// A plan of poses brought to the length a model is conditioned on: longer by linear interpolation (rotations by slerp
/// along the shorter arc), shorter by uniform sampling of the given poses. The last pose is always kept. Without
/// `start` the first is kept too; with `start`, the pose before the plan, the new poses are evenly spaced from it, as
/// the frames that follow the observation are. Throws ArgumentError if `poses` is empty or `length` is 0.
std::vector<PlanarPose> resample(std::span<const PlanarPose> poses, std::size_t length,
                                 const std::optional<PlanarPose>& start = {});
std::vector<Pose> resample(std::span<const Pose> poses, std::size_t length, const std::optional<Pose>& start = {});
std::vector<GripperPose> resample(std::span<const GripperPose> poses, std::size_t length,
                                  const std::optional<GripperPose>& start = {}, GripperRule rule = GripperRule::kStep);

}  // namespace wiw::action
