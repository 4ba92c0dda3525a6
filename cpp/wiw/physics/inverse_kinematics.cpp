// SPDX-License-Identifier: Apache-2.0
#include "wiw/physics/inverse_kinematics.hpp"

#include <Eigen/Cholesky>
#include <algorithm>
#include <cmath>
#include <limits>
#include <utility>

#include "wiw/core/error.hpp"
#include "wiw/core/intrinsics.hpp"
#include "wiw/core/rng.hpp"

namespace wiw::physics {

namespace {

constexpr int kMax = InverseKinematics::kMaxJoints;
using JointVector = Eigen::Matrix<double, Eigen::Dynamic, 1, 0, kMax, 1>;
using Jacobian = Eigen::Matrix<double, 6, Eigen::Dynamic, 0, 6, kMax>;
using Vector6 = Eigen::Matrix<double, 6, 1>;
using Matrix6 = Eigen::Matrix<double, 6, 6>;

constexpr double kDampingGain = 0.03;  // by squared error; found best of 0.003 to 0.5 on random Panda poses
constexpr double kDamping = 1e-4;      // what is left of the damping at the target
constexpr double kPositionWeight = 3;  // radians a metre: 33 cm of error count as much as one radian
constexpr double kLongestStep = 0.7;   // radians or metres by one joint in one iteration
constexpr int kPatience = 8;           // iterations without halving the error before an attempt is given up

/// Rotation vector of a rotation matrix.
Eigen::Vector3d log_of(const Eigen::Matrix3d& r) {
  const Eigen::Vector3d v(r(2, 1) - r(1, 2), r(0, 2) - r(2, 0), r(1, 0) - r(0, 1));  // 2 sin(angle) axis
  const double sine = v.norm() / 2, cosine = (r.trace() - 1) / 2;
  if (sine < 1e-6 || cosine < -0.9) {
    if (cosine > 0) return v / 2;
    const Eigen::AngleAxisd turn(r);
    return turn.angle() * turn.axis();
  }
  return v * (std::atan2(sine, cosine) / (2 * sine));
}

/// Where restarts put a joint: within its limits, which may be infinite, and as near to zero as these let it be.
std::pair<double, double> range_of_restarts(double lower, double upper) {
  const double low = std::max(lower, -kPi), high = std::min(upper, kPi);
  if (low <= high) return {low, high};
  // The limits lie beyond half a turn, on one side of it.
  return {std::isfinite(lower) ? lower : upper - 2 * kPi, std::isfinite(upper) ? upper : lower + 2 * kPi};
}

}  // namespace

const char* reason_text(IkReason reason) {
  switch (reason) {
    case IkReason::kReached: return "reached";
    case IkReason::kOutOfReach: return "out of reach";
    case IkReason::kJointLimits: return "joint limits";
    case IkReason::kNotConverged: return "not converged";
  }
  return "";
}

InverseKinematics::InverseKinematics(ArticulationPtr articulation, int link) : articulation_(std::move(articulation)) {
  const auto& joints = articulation_->joints();
  std::vector<int> way;
  for (int at = link; at > 0; at = joints[static_cast<std::size_t>(at) - 1].parent) way.insert(way.begin(), at - 1);
  for (const int i : way) {
    const Joint& joint = joints[static_cast<std::size_t>(i)];
    tail_ = tail_ * joint.origin;
    if (joint.index < 0) continue;
    if (joint.mimic) {
      throw ArgumentError("inverse kinematics: joint '" + joint.name +
                          "' mimics another; expected joints that move by themselves between base and link");
    }
    Pose turn = Pose::Identity();
    turn.linear() = Eigen::Quaterniond::FromTwoVectors(Eigen::Vector3d::UnitZ(), joint.axis).toRotationMatrix();
    const JointLimits& limits = articulation_->limits();
    chain_.push_back({tail_ * turn, joint.type == JointType::kPrismatic, joint.index, limits.lower[joint.index],
                      limits.upper[joint.index]});
    tail_ = turn.inverse();
  }
  if (chain_.empty() || chain_.size() > kMaxJoints) {
    throw ArgumentError("inverse kinematics needs 1 to " + std::to_string(kMaxJoints) + " joints; link '" +
                        articulation_->links()[static_cast<std::size_t>(link)].name + "' is moved by " +
                        std::to_string(chain_.size()));
  }
  reach_ = tail_.translation().norm();
  for (std::size_t i = 0; i < chain_.size(); ++i) {
    if (i > 0) reach_ += chain_[i].before.translation().norm();
    if (chain_[i].prismatic) reach_ += std::max(std::abs(chain_[i].lower), std::abs(chain_[i].upper));
  }
}

std::vector<int> InverseKinematics::joints() const {
  std::vector<int> indices;
  indices.reserve(chain_.size());
  for (const Step& step : chain_) indices.push_back(step.index);
  return indices;
}

/// The iteration's variables, all of fixed capacity.
struct InverseKinematics::Search {
  Search(const InverseKinematics& ik, const Pose& goal, const IkOptions& wanted)
      : chain(ik.chain_),
        tail(ik.tail_),
        target(goal),
        options(wanted),
        n(static_cast<Eigen::Index>(ik.chain_.size())) {
    q.resize(n);
    dq.resize(n);
    jacobian.resize(6, n);
  }

  /// Error and Jacobian at q.
  void evaluate() {
    Eigen::Matrix3d rotation = Eigen::Matrix3d::Identity();
    Eigen::Vector3d position = Eigen::Vector3d::Zero();
    for (Eigen::Index i = 0; i < n; ++i) {
      const Step& step = chain[static_cast<std::size_t>(i)];
      position += rotation * step.before.translation();
      rotation = (rotation * step.before.linear()).eval();
      jacobian.col(i).head<3>() = position;  // of the joint, until the tip is known
      jacobian.col(i).tail<3>() = rotation.col(2);
      if (step.prismatic) {
        position += q[i] * rotation.col(2);
      } else {
        const double c = std::cos(q[i]), s = std::sin(q[i]);
        const Eigen::Vector3d x = rotation.col(0);
        rotation.col(0) = c * x + s * rotation.col(1);
        rotation.col(1) = c * rotation.col(1) - s * x;
      }
    }
    position += rotation * tail.translation();
    rotation = (rotation * tail.linear()).eval();
    for (Eigen::Index i = 0; i < n; ++i) {
      const Eigen::Vector3d axis = jacobian.col(i).tail<3>();
      if (chain[static_cast<std::size_t>(i)].prismatic) {
        jacobian.col(i) << kPositionWeight * axis, Eigen::Vector3d::Zero();
      } else {
        const Eigen::Vector3d arm = position - jacobian.col(i).head<3>();
        jacobian.col(i).head<3>() = kPositionWeight * axis.cross(arm);
      }
    }
    const Eigen::Vector3d apart = target.translation() - position;
    const Eigen::Vector3d turn = log_of(target.linear() * rotation.transpose());
    position_error = apart.norm();
    rotation_error = turn.norm();
    error << kPositionWeight * apart, turn;
  }

  [[nodiscard]] bool done() const {
    return position_error <= options.position_tolerance && rotation_error <= options.rotation_tolerance;
  }

  /// Joints that stand at a limit and would go beyond leave the equations.
  void advance() {
    const double damping = kDampingGain * error.squaredNorm() + kDamping;
    for (Eigen::Index pass = 0; pass < n; ++pass) {
      const Matrix6 system = jacobian * jacobian.transpose() + damping * Matrix6::Identity();
      dq.noalias() = jacobian.transpose() * system.llt().solve(error);
      bool stopped = false;
      for (Eigen::Index i = 0; i < n; ++i) {
        const Step& step = chain[static_cast<std::size_t>(i)];
        if ((q[i] <= step.lower && dq[i] < 0) || (q[i] >= step.upper && dq[i] > 0)) {
          jacobian.col(i).setZero();
          stopped = true;
        }
      }
      if (!stopped) break;
    }
    dq *= std::min(1.0, kLongestStep / dq.cwiseAbs().maxCoeff());
    for (Eigen::Index i = 0; i < n; ++i) {
      const Step& step = chain[static_cast<std::size_t>(i)];
      q[i] = std::clamp(q[i] + dq[i], step.lower, step.upper);
    }
  }

  /// From the present q until the target, or until it no longer comes nearer.
  bool attempt() {
    double mark = std::numeric_limits<double>::infinity();
    int since = 0;
    for (int i = 0; i < options.iterations; ++i) {
      evaluate();
      ++iterations;
      if (done()) return true;
      const double size = error.norm();
      if (size < mark / 2) mark = size, since = 0;
      if (++since > kPatience) break;
      advance();
      if (!(dq.squaredNorm() > 1e-16)) break;
    }
    evaluate();
    return done();
  }

  void randomise(Rng& rng) {
    for (Eigen::Index i = 0; i < n; ++i) {
      const Step& step = chain[static_cast<std::size_t>(i)];
      const auto [low, high] = range_of_restarts(step.lower, step.upper);
      q[i] = rng.uniform(low, high);
    }
  }

  [[nodiscard]] bool at_limit() const {
    for (Eigen::Index i = 0; i < n; ++i) {
      const Step& step = chain[static_cast<std::size_t>(i)];
      if (q[i] <= step.lower || q[i] >= step.upper) return true;
    }
    return false;
  }

  const std::vector<Step>& chain;
  const Pose& tail;
  const Pose target;
  const IkOptions& options;
  const Eigen::Index n;
  JointVector q, dq;
  Jacobian jacobian;
  Vector6 error = Vector6::Zero();
  double position_error = 0, rotation_error = 0;
  int iterations = 0;
};

void IkOptions::validate() const {
  if (!(position_tolerance > 0) || !(rotation_tolerance > 0)) {
    throw ArgumentError("inverse kinematics: expected positive tolerances, got position_tolerance=" +
                        std::to_string(position_tolerance) +
                        ", rotation_tolerance=" + std::to_string(rotation_tolerance));
  }
  if (iterations < 1 || restarts < 0) {
    throw ArgumentError("inverse kinematics: expected iterations of 1 or more and restarts of 0 or more, got " +
                        std::to_string(iterations) + " and " + std::to_string(restarts));
  }
}

IkResult InverseKinematics::solve(const Pose& T_base_link, const Eigen::VectorXd& start,
                                  const IkOptions& options) const {
  check_pose(T_base_link, "T_base_link");
  articulation_->check_positions(start, "start");
  options.validate();
  Search search(*this, T_base_link, options);
  const bool near = (T_base_link.translation() - chain_[0].before.translation()).norm() <= reach_;
  const int attempts = near ? options.restarts + 1 : 1;
  IkResult result{.reason = near ? IkReason::kNotConverged : IkReason::kOutOfReach, .joints = start};
  for (Eigen::Index i = 0; i < search.n; ++i) {
    const Step& step = chain_[static_cast<std::size_t>(i)];
    search.q[i] = std::clamp(start[step.index], step.lower, step.upper);
  }
  double best = std::numeric_limits<double>::infinity();
  Rng rng(fold_key({options.seed}));
  for (; result.attempts < attempts && !result.reached(); ++result.attempts) {
    if (result.attempts > 0) search.randomise(rng);
    const bool reached = search.attempt();
    if (!reached && search.error.norm() >= best) continue;
    best = search.error.norm();
    result.position_error = search.position_error;
    result.rotation_error = search.rotation_error;
    for (Eigen::Index i = 0; i < search.n; ++i) result.joints[chain_[static_cast<std::size_t>(i)].index] = search.q[i];
    if (reached) {
      result.reason = IkReason::kReached;
    } else if (near) {
      result.reason = search.at_limit() ? IkReason::kJointLimits : IkReason::kNotConverged;
    }
  }
  result.iterations = search.iterations;
  return result;
}

}  // namespace wiw::physics
