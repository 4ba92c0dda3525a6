// SPDX-License-Identifier: Apache-2.0
#include "wiw/action/resample.hpp"

#include <cmath>

#include "wiw/core/error.hpp"

namespace wiw::action {

namespace {

/// Position of new pose i on the axis where given pose k lies at k and the start at -1.
double position_of(std::size_t i, std::size_t length, std::size_t count, bool has_start) {
  const auto index = static_cast<double>(i);
  if (has_start) return (index + 1) * static_cast<double>(count) / static_cast<double>(length) - 1;
  if (length == 1) return static_cast<double>(count - 1);
  return index * static_cast<double>(count - 1) / static_cast<double>(length - 1);
}

template <class T, class Interpolate>
std::vector<T> resample_with(std::span<const T> poses, std::size_t length, const std::optional<T>& start,
                             Interpolate interpolate) {
  if (poses.empty() || length == 0) {
    throw ArgumentError("resample: expected at least one pose and a length of at least 1, got " +
                        std::to_string(poses.size()) + " poses and length " + std::to_string(length));
  }
  const auto last = static_cast<double>(poses.size() - 1);
  const auto at = [&](double index) -> const T& {
    return index < 0 ? *start : poses[static_cast<std::size_t>(std::min(index, last))];
  };
  std::vector<T> resampled;
  resampled.reserve(length);
  for (std::size_t i = 0; i < length; ++i) {
    const double position = position_of(i, length, poses.size(), start.has_value());
    const double nearest = std::nearbyint(position);
    // Shortening samples given poses; a new pose that falls on a given one is that pose, bit by bit.
    if (length <= poses.size() || std::abs(position - nearest) < 1e-9) {
      resampled.push_back(at(nearest));
    } else {
      const double below = std::floor(position);
      resampled.push_back(interpolate(at(below), at(below + 1), position - below));
    }
  }
  return resampled;
}

}  // namespace

std::vector<PlanarPose> resample(std::span<const PlanarPose> poses, std::size_t length,
                                 const std::optional<PlanarPose>& start) {
  return resample_with(poses, length, start, [](const PlanarPose& a, const PlanarPose& b, double t) {
    const double turn = std::remainder(b.azimuth - a.azimuth, 2 * kPi);
    return PlanarPose{a.x + t * (b.x - a.x), a.y + t * (b.y - a.y), a.azimuth + t * turn};
  });
}

std::vector<Pose> resample(std::span<const Pose> poses, std::size_t length, const std::optional<Pose>& start) {
  return resample_with(poses, length, start, [](const Pose& a, const Pose& b, double t) {
    Pose pose = Pose::Identity();
    pose.linear() =
        Eigen::Quaterniond(a.linear()).slerp(t, Eigen::Quaterniond(b.linear())).normalized().toRotationMatrix();
    pose.translation() = a.translation() + t * (b.translation() - a.translation());
    return pose;
  });
}

std::vector<GripperPose> resample(std::span<const GripperPose> poses, std::size_t length,
                                  const std::optional<GripperPose>& start, GripperRule rule) {
  return resample_with(poses, length, start, [rule](const GripperPose& a, const GripperPose& b, double t) {
    const bool arrived = rule == GripperRule::kNearest && t >= 0.5;
    return GripperPose{a.position + t * (b.position - a.position),
                       to_rpy(to_quaternion(a.rpy).slerp(t, to_quaternion(b.rpy))), arrived ? b.gripper : a.gripper};
  });
}

}  // namespace wiw::action
