// SPDX-License-Identifier: Apache-2.0
#include "wiw/reproject/warp.hpp"

#include <doctest/doctest.h>

#include <algorithm>
#include <cmath>

#include "wiw/core/error.hpp"
#include "wiw/core/rng.hpp"
#include "wiw/panorama/projection.hpp"

using namespace wiw;
using namespace wiw::reproject;

namespace {

struct Picture {
  std::vector<std::uint8_t> color;
  std::vector<float> depth;
};

Eigen::Vector3d ray(const View& view, int x, int y) {
  if (view.panoramic) return panorama::pixel_direction(x, y, view.size);
  const double focal = Intrinsics{view.size, view.hfov}.focal();
  return {(x + 0.5 - view.size.width / 2.0) / focal, -(y + 0.5 - view.size.height / 2.0) / focal, -1.0};
}

/// Noise on the walls of a box room with a pillar, in front of which everything is cut.
Picture room(const View& view, std::uint64_t seed) {
  const Eigen::Vector3d low(-3, -1, -4);
  const Eigen::Vector3d high(2.5, 1.6, 3);
  Picture picture;
  Rng rng(seed);
  for (int y = 0; y < view.size.height; ++y) {
    for (int x = 0; x < view.size.width; ++x) {
      const Eigen::Vector3d d = ray(view, x, y);
      double depth = 1e9;
      for (int axis = 0; axis < 3; ++axis) depth = std::min(depth, (d[axis] > 0 ? high : low)[axis] / d[axis]);
      if (std::abs(d.x() + 0.1) < 0.08 && d.z() < -0.5) depth = std::min(depth, 1.5);
      picture.depth.push_back(static_cast<float>(depth));
      for (int c = 0; c < 3; ++c) picture.color.push_back(static_cast<std::uint8_t>(rng.below(256)));
    }
  }
  return picture;
}

struct Result {
  std::vector<std::uint8_t> color, hole;
  std::vector<float> depth;
  bool operator==(const Result&) const = default;
};

Result run(const Warp& warp, const Picture& picture, const std::vector<Pose>& poses, Isa isa) {
  const std::size_t pixels = warp.target().size.pixels() * poses.size();
  Result result{std::vector<std::uint8_t>(3 * pixels), std::vector<std::uint8_t>(pixels), std::vector<float>(pixels)};
  warp(picture.color.data(), picture.depth.data(), 1, poses,
       {result.color.data(), result.depth.data(), result.hole.data()}, isa);
  return result;
}

const View kPanorama{true, {90, 160}};
const View kPinhole{false, {70, 90}, radians(80)};

std::vector<Pose> some_poses() {
  return {Pose::Identity(), pose_from_yaw({0.3, 0.1, -0.8}, 0.7), pose_from_yaw({0, 0, -1.2}, kPi),
          pose_from_yaw({1, 0.9, 1}, -2)};
}

}  // namespace

TEST_CASE("every instruction set gives the same bytes, from any view to any view") {
  for (const View& source : {kPanorama, kPinhole}) {
    for (const View& target : {kPanorama, kPinhole}) {
      const Warp warp(source, target);
      const Picture picture = room(source, 1);
      const Result expected = run(warp, picture, some_poses(), Isa::kScalar);
      for (const Isa isa : {Isa::kAvx2, Isa::kAvx512}) {
        if (isa <= native_isa()) CHECK(run(warp, picture, some_poses(), isa) == expected);
      }
    }
  }
}

TEST_CASE("a closed convex room seen from inside has no cracks, at the seam and at the poles included") {
  Picture picture = room(kPanorama, 2);
  for (int y = 0; y < kPanorama.size.height; ++y) {
    for (int x = 0; x < kPanorama.size.width; ++x) {
      const Eigen::Vector3d d = ray(kPanorama, x, y);
      double depth = 1e9;
      for (int axis = 0; axis < 3; ++axis) depth = std::min(depth, 1.5 / std::abs(d[axis]));
      picture.depth[static_cast<std::size_t>(y * kPanorama.size.width + x)] = static_cast<float>(depth);
    }
  }
  const Warp warp(kPanorama, kPanorama);
  for (int step = 0; step < 24; ++step) {
    // Level moves in all directions: the source's polar caps, where it has no texel, become a pixel or two.
    const double angle = 0.3 * step;
    const Pose pose = pose_from_yaw(0.9 * Eigen::Vector3d(std::sin(angle), 0, -std::cos(angle)), 0.17 * step);
    const Result result = run(warp, picture, {pose}, active_isa());
    int holes = 0;
    for (const std::uint8_t hole : result.hole) holes += hole;
    CAPTURE(step);
    CHECK(holes <= 12);
    for (int y = 0; y < kPanorama.size.height; ++y) {
      for (int x = 0; x < kPanorama.size.width; ++x) {
        const std::size_t i = static_cast<std::size_t>(y * kPanorama.size.width + x);
        const Eigen::Vector3d d = pose.linear() * ray(kPanorama, x, y);
        double depth = 1e9;
        for (int axis = 0; axis < 3; ++axis) {
          depth = std::min(depth, ((d[axis] > 0 ? 1.5 : -1.5) - pose.translation()[axis]) / d[axis]);
        }
        // Triangles of two-degree texels cut the room's edges off.
        if (result.hole[i] == 0) CHECK(std::abs(result.depth[i] - depth) < 0.06 * depth);
      }
    }
  }
}

TEST_CASE("a wall seen through a mesh is the wall: colour comes from where the point was") {
  // Each texel's colour is its own column, so a look-up elsewhere shows at once.
  Picture picture = room(kPinhole, 3);
  for (std::size_t i = 0; i < picture.depth.size(); ++i) {
    picture.depth[i] = 2.0F;
    const auto column = static_cast<std::uint8_t>(2 * (i % static_cast<std::size_t>(kPinhole.size.width)));
    for (std::size_t c = 0; c < 3; ++c) picture.color[3 * i + c] = column;
  }
  const Warp warp(kPinhole, kPinhole);
  const double focal = Intrinsics{kPinhole.size, kPinhole.hfov}.focal();
  const Result result = run(warp, picture, {pose_from_yaw({0.2, 0.0, -0.5}, 0.0)}, active_isa());
  for (int y = 0; y < kPinhole.size.height; ++y) {
    for (int x = 0; x < kPinhole.size.width; ++x) {
      const std::size_t i = static_cast<std::size_t>(y * kPinhole.size.width + x);
      const double point = ray(kPinhole, x, y).x() * 1.5 + 0.2;
      const double column = point / 2.0 * focal + kPinhole.size.width / 2.0 - 0.5;
      if (column < 0.0 || column > kPinhole.size.width - 1.0) continue;
      CHECK(result.hole[i] == 0);
      CHECK(result.depth[i] == doctest::Approx(1.5));
      CHECK(std::abs(result.color[3 * i] - 2.0 * column) < 0.6);
    }
  }
}

TEST_CASE("a surface one pixel wide stays one pixel wide") {
  Picture picture = room(kPinhole, 4);
  const int at = 50;
  for (int y = 0; y < kPinhole.size.height; ++y) {
    for (int x = 0; x < kPinhole.size.width; ++x)
      picture.depth[static_cast<std::size_t>(y * kPinhole.size.width + x)] = x == at ? 1.0F : 5.0F;
  }
  const Warp warp(kPinhole, kPinhole);
  const Result result = run(warp, picture, {Pose(Eigen::Translation3d(0.003, 0.0, 0.0))}, active_isa());
  for (int y = 0; y < kPinhole.size.height; ++y) {
    int near = 0;
    for (int x = 0; x < kPinhole.size.width; ++x)
      near += result.depth[static_cast<std::size_t>(y * kPinhole.size.width + x)] < 2.0F ? 1 : 0;
    CHECK(near == 1);
  }
}

TEST_CASE("a surface seen from behind hides what lies beyond it and is a hole") {
  // A screen stands before a wall; the camera goes past the screen and looks back at it.
  Picture picture = room(kPanorama, 6);
  const Size& size = kPanorama.size;
  for (int y = 0; y < size.height; ++y) {
    for (int x = 0; x < size.width; ++x) {
      const Eigen::Vector3d d = ray(kPanorama, x, y);
      if (d.z() < 0 && std::abs(d.x()) < -0.5 * d.z() && std::abs(d.y()) < -0.5 * d.z())
        picture.depth[static_cast<std::size_t>(y * size.width + x)] = static_cast<float>(-1.0 / d.z());
    }
  }
  const Warp warp(kPanorama, {false, {40, 40}, radians(40)});
  const Result result = run(warp, picture, {pose_from_yaw({0, 0, -2}, kPi)}, active_isa());
  CHECK(std::count(result.hole.begin(), result.hole.end(), 1) == 40 * 40);
}

TEST_CASE("sky behind something near lies in the window, not on what hangs before it") {
  // A window fills the wall 4 m ahead from column to column; the left of it ends at a curtain 1 m away.
  Picture picture = room(kPinhole, 7);
  const Size& size = kPinhole.size;
  for (int y = 0; y < size.height; ++y) {
    for (int x = 0; x < size.width; ++x) {
      const bool window = x >= 20 && x < 60 && y >= 20 && y < 50;
      picture.depth[static_cast<std::size_t>(y * size.width + x)] = window ? 0.0F : x < 20 ? 1.0F : 4.0F;
    }
  }
  const Warp warp(kPinhole, kPinhole);
  // A sky hung between curtain and wall would slant and cover what the curtain uncovers.
  const Result result = run(warp, picture, {pose_from_yaw({0.5, 0, 0}, 0)}, active_isa());
  const double focal = Intrinsics{size, kPinhole.hfov}.focal();
  const int moved = static_cast<int>(std::lround(0.5 / 4.0 * focal));
  const std::size_t row = 35 * static_cast<std::size_t>(size.width);
  for (int x = 0; x < 20 - moved - 1; ++x) CHECK(result.hole[row + static_cast<std::size_t>(x)] == 1);
  for (int x = 20 - moved + 1; x < size.width - moved - 1; ++x) {
    CHECK(result.hole[row + static_cast<std::size_t>(x)] == 0);
    if (x < 60 - moved - 1) CHECK(result.depth[row + static_cast<std::size_t>(x)] == 0.0F);
    if (x > 60 - moved) CHECK(result.depth[row + static_cast<std::size_t>(x)] == doctest::Approx(4.0));
  }
}

TEST_CASE("wrong arguments are refused") {
  CHECK_THROWS_AS(Warp({true, {1, 10}}, kPanorama), ArgumentError);
  CHECK_THROWS_AS(Warp(kPanorama, {false, {10, 10}, 4.0}), ArgumentError);
  CHECK_THROWS_AS(Warp(kPanorama, kPanorama, 0.0F), ArgumentError);
  const Picture picture = room(kPanorama, 5);
  const Warp warp(kPanorama, kPanorama);
  const std::vector<Pose> three(3, Pose::Identity());
  CHECK_THROWS_AS(warp(picture.color.data(), picture.depth.data(), 2, three, {}), ArgumentError);
}
