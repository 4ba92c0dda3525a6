// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <array>
#include <span>
#include <string>

#include "wiw/action/action.hpp"
#include "wiw/action/gripper_pose.hpp"

namespace wiw::action {

/// How a navigation plan is put into words for models steered by a prompt. `{actions}` in the prompt is replaced by the
/// phrases joined with the separator; `{metres}`, `{degrees}` and `{count}` in a phrase by what the phrase covers.
struct TextTemplate {
  std::string prompt =
      "First-person view of a camera moving through a still indoor scene. Step by step, the camera does this: "
      "{actions}.";
  std::array<std::string, kActionCount> phrases = {
      "hold still", "move forward {metres} m", "turn left {degrees} degrees", "turn right {degrees} degrees", "stop"};
  std::string separator = ", then ";
  /// One phrase for a run of equal primitives ("move forward 0.6 m") instead of one for each.
  bool merge_runs = false;

  bool operator==(const TextTemplate&) const = default;
};

/// How a plan of end-effector poses is put into words; the phrase may use {x} {y} {z} (metres), {roll} {pitch} {yaw}
/// (degrees) and {gripper} ("open" or "closed").
struct GripperTextTemplate {
  std::string prompt = "A robot arm works at a table. Step by step, its gripper does this: {actions}.";
  std::string phrase = "moves to ({x}, {y}, {z}) m, turned by ({roll}, {pitch}, {yaw}) degrees, {gripper}";
  std::string separator = ", then ";

  bool operator==(const GripperTextTemplate&) const = default;
};

std::string to_text(std::span<const Action> actions, const TextTemplate& words, const ActionSpace& space);
std::string to_text(std::span<const GripperPose> poses, const GripperTextTemplate& words);

}  // namespace wiw::action
