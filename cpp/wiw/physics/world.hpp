// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <Eigen/Core>
#include <array>
#include <memory>
#include <optional>
#include <span>
#include <string>
#include <vector>

#include "wiw/physics/articulation.hpp"
#include "wiw/physics/shape.hpp"

namespace wiw::physics {

struct WorldOptions {
  Eigen::Vector3d gravity{0, 0, -9.81};  // m/s2; z is up, the frame of robots
  double time_step = 1.0 / 240;          // seconds
  int iterations = 50;                   // of the constraint solver, at most
  double residual = 1e-7;                // an island whose squared velocity error falls below this is solved
};

/// A rigid body of one or several parts; of mass 0 it is static.
struct Body {
  std::string name;
  std::vector<Part> parts;
  double mass = 0;  // kg, spread evenly over the parts' volume
  double friction = 0.5;
  double restitution = 0;
  Pose T_world_body = Pose::Identity();
};

using Vector6 = Eigen::Matrix<double, 6, 1>;  // linear above angular

/// One side of a contact: a body, or a link of an articulation; what does not apply is -1.
struct ContactSide {
  int body = -1, articulation = -1, link = -1;
  bool operator==(const ContactSide&) const = default;
};

struct Contact {
  ContactSide a, b;
  Eigen::Vector3d position;  // on b's surface, world
  Eigen::Vector3d normal;    // unit, from b towards a
  double distance;           // metres, negative where they overlap
};

/// A body held by a link: the fixed constraint's frame.
struct Attachment {
  int articulation, link, body;
  Pose T_frame_body;  // frame: the principal frame of the links that move as one with `link`
};

/// Everything that changes in a world. Fits every world that was built by the same calls.
struct WorldState {
  std::int64_t steps = 0;
  std::vector<double> numbers;
  std::vector<Attachment> attachments;
  std::vector<int> layout;  // of the world: how many bodies, then joints and links of each articulation
};

/// What an arm may touch along its path.
struct Touchable {
  std::vector<int> bodies, articulations;
};

/// Where along a joint path the arm, or what it holds, first touches something.
struct PathCollision {
  int waypoint;
  Contact contact;
};

/// Rigid bodies and articulations under gravity and contact (Bullet, double precision, fixed time step).
///
/// Deterministic: the next state is a function of the present one and the commands, to the last bit. A fork, or a
/// restored snapshot, goes on exactly as the original does. Contacts are found afresh at every step and nothing is
/// carried over from earlier ones. One thread at a time may use a world; different worlds are independent.
///
/// Links of one articulation do not collide with each other; with everything else they do, static bodies included.
/// Links that are fixed to the base collide with moving bodies only.
///
/// Joints are driven by velocity-limited motors: each step closes `kMotorGain` of the distance to the target, at most
/// at the joint's velocity limit and with at most its force. Targets start as the positions that were set. A joint that
/// mimics another has that one's target, times its multiplier, plus its offset; nothing else couples the two.
class World {
 public:
  static constexpr double kMotorGain = 0.2;

  explicit World(const WorldOptions& options = {});
  ~World();
  World(const World&) = delete;
  World& operator=(const World&) = delete;

  [[nodiscard]] const WorldOptions& options() const;
  /// Seconds since the world was made.
  [[nodiscard]] double time() const;

  /// Index of the body, from 0. ArgumentError for impossible shapes, mass or pose.
  int add_body(const Body& body);
  /// Index of the articulation, from 0; its joints start at the positions nearest to zero that the limits allow.
  int add_articulation(ArticulationPtr articulation, const Pose& T_world_base = Pose::Identity());
  [[nodiscard]] int body_count() const;
  [[nodiscard]] const Body& body(int body) const;
  [[nodiscard]] const ArticulationPtr& articulation(int articulation) const;
  [[nodiscard]] const Pose& base_pose(int articulation) const;

  /// Advances by whole time steps.
  void step(int count = 1);

  [[nodiscard]] std::vector<Pose> body_poses() const;
  [[nodiscard]] std::vector<Vector6> body_velocities() const;
  /// Puts a body somewhere, at rest.
  void set_body_pose(int body, const Pose& T_world_body);
  void set_body_velocity(int body, const Vector6& velocity);

  [[nodiscard]] Eigen::VectorXd joint_positions(int articulation) const;
  [[nodiscard]] Eigen::VectorXd joint_velocities(int articulation) const;
  [[nodiscard]] Eigen::VectorXd joint_targets(int articulation) const;
  [[nodiscard]] Eigen::VectorXd joint_forces(int articulation) const;
  /// T_world_link of every link, by forward kinematics.
  [[nodiscard]] std::vector<Pose> link_poses(int articulation) const;
  /// T_world_link of every link as Bullet holds them, for comparison.
  [[nodiscard]] std::vector<Pose> simulated_link_poses(int articulation) const;
  /// Puts the joints somewhere, at rest, and targets there. Held bodies stay where they are, and the next steps would
  /// pull them to the link: let go of them before, or put them where they belong after.
  void set_joint_positions(int articulation, const Eigen::VectorXd& positions);
  void set_joint_velocities(int articulation, const Eigen::VectorXd& velocities);
  /// Where the motors go from the next step on. ArgumentError for NaN and for targets outside the limits.
  void set_joint_targets(int articulation, const Eigen::VectorXd& targets);
  /// What motors may exert, newton metres or newtons; 0 lets a joint swing freely.
  void set_joint_forces(int articulation, const Eigen::VectorXd& forces);

  /// Surfaces that overlap, or are at most `distance` metres apart, where things are now. Nothing further apart than 2
  /// % of its size is looked at, and two boxes are seen only where they overlap.
  [[nodiscard]] std::vector<Contact> contacts(double distance = 0);
  /// Puts the articulation at each of `positions` in turn, held bodies along with it, and returns the first overlap by
  /// more than `tolerance` metres with anything but what is `allowed`. Overlaps of the first position may go on, but
  /// not deepen by more than that: an arm that touches something can leave it. The state stays as it is.
  std::optional<PathCollision> first_collision(int articulation, const std::vector<Eigen::VectorXd>& positions,
                                               const Touchable& allowed, double tolerance);

  /// Holds a dynamic body by a link, where both are now.
  void attach(int articulation, int link, int body);
  /// Lets go of every body that the articulation holds.
  void detach(int articulation);
  [[nodiscard]] const std::vector<Attachment>& attachments() const;

  [[nodiscard]] WorldState snapshot() const;
  /// ArgumentError if the snapshot is of a world that was built otherwise.
  void restore(const WorldState& state);
  /// From now on keeps a snapshot of every step, the present state first. What is recorded is no part of the state.
  void record();
  /// What was kept, oldest first; ends the recording.
  std::vector<WorldState> recorded();
  /// An independent world in the same state.
  [[nodiscard]] std::unique_ptr<World> fork() const;

 private:
  struct Impl;
  std::unique_ptr<Impl> impl_;
};

}  // namespace wiw::physics
