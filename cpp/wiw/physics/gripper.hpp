// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <array>
#include <optional>
#include <string>

#include "wiw/physics/world.hpp"

namespace wiw::physics {

/// Which joints and links make the gripper; lower limits are closed, upper ones open.
struct GripperNames {
  std::array<std::string, 2> joints{"panda_finger_joint1", "panda_finger_joint2"};
  std::array<std::string, 2> fingers{"panda_leftfinger", "panda_rightfinger"};
  std::string hand = "panda_hand";
};

/// Two fingers that grasp. They close with contact, which centres what lies between them; when both touch the same
/// dynamic body, a constraint holds it and the fingers go on pressing. All of its state lies in the world, which must
/// outlive it; a fork of the world takes a gripper of its own.
class Gripper {
 public:
  /// `force`: newtons that each finger presses with.
  Gripper(World& world, int articulation, const GripperNames& names = {}, double force = 20);

  /// Closes until the fingers stand still, at most `steps`; returns the body that is held now, if any.
  std::optional<int> close(int steps = 480);
  /// Lets go and opens to `amount` of the way (in [0, 1]) until the fingers stand still, at most `steps`.
  void open(double amount = 1, int steps = 480);

  /// Opening of the gripper, from 0 (closed) to 1 (open).
  [[nodiscard]] double opening() const;
  [[nodiscard]] std::optional<int> held() const;
  /// The dynamic body that both fingers touch.
  [[nodiscard]] std::optional<int> find_body_between_fingers();

 private:
  void move(double amount, int steps);
  [[nodiscard]] bool still() const;

  World& world_;
  const int articulation_;
  std::array<int, 2> joints_{}, fingers_{};
  int hand_;
  double force_;
};

}  // namespace wiw::physics
