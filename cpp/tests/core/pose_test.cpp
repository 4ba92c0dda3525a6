// SPDX-License-Identifier: Apache-2.0
#include "wiw/core/pose.hpp"

#include <doctest/doctest.h>

#include "wiw/core/intrinsics.hpp"

using namespace wiw;

TEST_CASE("yaw 0 looks along -Z and a left turn looks along -X") {
  const Pose front = pose_from_yaw(Eigen::Vector3d(1, 2, 3), 0);
  CHECK((front * Eigen::Vector3d(0, 0, -1)).isApprox(Eigen::Vector3d(1, 2, 2)));
  const Pose left = pose_from_yaw(Eigen::Vector3d::Zero(), kPi / 2);
  CHECK((left * Eigen::Vector3d(0, 0, -1)).isApprox(Eigen::Vector3d(-1, 0, 0), 1e-12));
  for (const double yaw : {-3.0, -0.3, 0.0, 1.2, 3.1}) {
    CHECK(yaw_of(pose_from_yaw(Eigen::Vector3d::Zero(), yaw)) == doctest::Approx(yaw));
  }
}

TEST_CASE("a 90 degree view has a focal length of half its width") {
  CHECK(Intrinsics{.size = {480, 480}, .hfov = kPi / 2}.focal() == doctest::Approx(240));
}
