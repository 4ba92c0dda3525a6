// SPDX-License-Identifier: Apache-2.0
#include "wiw/metrics/pose_error.hpp"

namespace wiw::metrics {

PoseError pose_error(const Pose& a, const Pose& b) {
  const Eigen::Quaterniond from(a.linear());
  const Eigen::Quaterniond to(b.linear());
  return {(a.translation() - b.translation()).norm(), from.angularDistance(to)};
}

}  // namespace wiw::metrics
