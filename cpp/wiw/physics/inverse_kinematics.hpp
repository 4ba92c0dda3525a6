// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstdint>
#include <vector>

#include "wiw/physics/articulation.hpp"

namespace wiw::physics {

struct IkOptions {
  double position_tolerance = 1e-4;  // metres
  double rotation_tolerance = 1e-3;  // radians
  int iterations = 60;               // of one attempt, at most
  int restarts = 30;                 // from random joint positions, after the attempt from `start`
  std::uint64_t seed = 0;

  void validate() const;  // ArgumentError for tolerances that are not positive, and for negative counts
};

enum class IkReason { kReached, kOutOfReach, kJointLimits, kNotConverged };
const char* reason_text(IkReason reason);

struct IkResult {
  IkReason reason = IkReason::kNotConverged;
  Eigen::VectorXd joints;  // of all movable joints; of the best attempt where the pose is not reached
  double position_error = 0, rotation_error = 0;
  int iterations = 0;  // of all attempts together
  int attempts = 0;
  [[nodiscard]] bool reached() const { return reason == IkReason::kReached; }
};

/// Joint positions that bring a link to a pose, by damped least squares whose damping falls with the squared error
/// (Sugihara, "Solvability-unconcerned inverse kinematics by the Levenberg-Marquardt method", 2011).
/// Joints stop at their limits, and those that would go beyond leave the equations. Solving allocates nothing until the
/// result; the answer is a function of the arguments alone. Immutable.
class InverseKinematics {
 public:
  static constexpr int kMaxJoints = 16;

  /// ArgumentError if no joint, or more than kMaxJoints, move the link.
  InverseKinematics(ArticulationPtr articulation, int link);

  /// `T_base_link` as in Articulation::forward_kinematics; joints that do not move the link stay as in `start`.
  [[nodiscard]] IkResult solve(const Pose& T_base_link, const Eigen::VectorXd& start,
                               const IkOptions& options = {}) const;

  [[nodiscard]] const Articulation& articulation() const { return *articulation_; }
  /// Movable joints between base and link, from the base on.
  [[nodiscard]] std::vector<int> joints() const;

 private:
  struct Step {  // one joint of the chain, turned so that it moves along or about z
    Pose before;
    bool prismatic;
    int index;
    double lower, upper;
  };
  struct Search;

  ArticulationPtr articulation_;
  std::vector<Step> chain_;
  Pose tail_ = Pose::Identity();
  double reach_ = 0;  // no target can lie further than this from the first joint
};

}  // namespace wiw::physics
