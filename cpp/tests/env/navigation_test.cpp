// SPDX-License-Identifier: Apache-2.0
#include <doctest/doctest.h>

#include "env/rooms.hpp"
#include "wiw/action/trajectory.hpp"
#include "wiw/core/error.hpp"

using namespace wiw;
using namespace wiw::env;
using namespace wiw::testing;
using Eigen::Vector3d;

namespace {

const NavigationWorld& world() {
  static const NavigationWorld world = make_world(0.5f);
  return world;
}

NavigationEnv env_at(double x, double z, double yaw, Motion motion = Motion::kRefuse) {
  NavigationEnv env(world(), small_pictures(motion));
  env.reset({x, 0, z}, yaw);
  return env;
}

const action::ActionSequence kWalk{action::Action::kForward,   action::Action::kTurnLeft,  action::Action::kForward,
                                   action::Action::kTurnRight, action::Action::kTurnRight, action::Action::kForward,
                                   action::Action::kTurnRight, action::Action::kForward};

}  // namespace

TEST_CASE("a forward step is 0.2 m along the heading and keeps the floor's height") {
  NavigationEnv env = env_at(1, 1, -kPi / 2);  // towards +x
  const Vector3d before = env.position();
  CHECK(env.step(action::Action::kForward));
  CHECK((env.position() - before - Vector3d(0.2, 0, 0)).norm() < 1e-5);
  CHECK(!env.step(action::Action::kStop));
  CHECK(!env.step(action::Action::kNull));
}

TEST_CASE("refuse: a step whose end is not navigable leaves the agent where it is") {
  NavigationEnv env = env_at(1, 3, -kPi / 2 + 0.2);  // into the block, a little towards -z
  int refused = 0;
  for (int i = 0; i < 12; ++i) {
    const Vector3d before = env.position();
    const Vector3d end = before + 0.2 * Vector3d(-std::sin(env.yaw()), 0, -std::cos(env.yaw()));
    const bool free = world().navmesh->is_navigable(end.cast<float>());
    CHECK(env.step(action::Action::kForward) == free);
    CHECK((env.position() - (free ? end : before)).norm() < 1e-5);
    refused += !free;
  }
  CHECK(refused >= 4);
  CHECK(env.position().x() < 2.5);
}

TEST_CASE("slide: the agent goes on along the block") {
  NavigationEnv sliding = env_at(1, 3.5, -kPi / 2 + 0.4, Motion::kSlide);
  NavigationEnv refusing = env_at(1, 3.5, -kPi / 2 + 0.4);
  for (int i = 0; i < 24; ++i) {
    sliding.step(action::Action::kForward);
    refusing.step(action::Action::kForward);
    CHECK(world().navmesh->is_navigable(sliding.position().cast<float>()));
  }
  CHECK(refusing.position().z() > 2);   // stuck beside the block
  CHECK(sliding.position().z() < 1.9);  // past its corner
  CHECK(sliding.position().x() > 2.5);
}

TEST_CASE("odometry is the way in the frame of the reset, as the action API computes it") {
  for (const double yaw : {0.0, 1.1, -2.9}) {
    NavigationEnv env = env_at(1.2, 1.2, yaw);
    CHECK(env.odometry().norm() == 0);
    const auto expected = action::to_trajectory(kWalk, env.config().actions);
    for (std::size_t k = 0; k < kWalk.size(); ++k) {
      REQUIRE(env.step(kWalk[k]));
      const Vector3d odometry = env.odometry();
      CHECK((odometry - Vector3d(expected[k].x, expected[k].y, expected[k].azimuth)).norm() < 1e-5);
    }
    env.reset({4.5, 0, 1}, yaw + 1);
    CHECK(env.odometry().norm() == 0);
  }
}

TEST_CASE("sixteen turns are a circle to the last bit") {
  NavigationEnv env = env_at(1, 1, 0.3);
  for (int i = 0; i < 16; ++i) env.step(action::Action::kTurnRight);
  CHECK(env.yaw() == 0.3);
  CHECK(env.odometry().z() == 0);
}

TEST_CASE("a copy is a fork: neither moves the other") {
  NavigationEnv env = env_at(1, 1, 0);
  NavigationEnv fork = env;
  fork.step(action::Action::kTurnRight);
  fork.step(action::Action::kForward);
  CHECK(env.position() == env_at(1, 1, 0).position());
  CHECK(env.yaw() == 0);
  const Pose forked = fork.T_world_camera();
  env.step(action::Action::kTurnLeft);
  CHECK(fork.T_world_camera().matrix() == forked.matrix());
}

TEST_CASE("camera_poses_after is what stepping leads to, blocked steps included") {
  action::ActionSequence plan = kWalk;
  plan.insert(plan.end(), 12, action::Action::kForward);
  for (const Motion motion : {Motion::kRefuse, Motion::kSlide}) {
    NavigationEnv env = env_at(1.5, 2.5, -1.2, motion);
    const std::vector<Pose> poses = env.camera_poses_after(plan);
    REQUIRE(poses.size() == plan.size());
    CHECK(env.odometry().norm() == 0);
    for (std::size_t k = 0; k < plan.size(); ++k) {
      env.step(plan[k]);
      CHECK(poses[k].matrix() == env.T_world_camera().matrix());
    }
  }
}

TEST_CASE("the camera looks along the heading from 1 m above the floor") {
  const NavigationEnv env = env_at(1, 1, -kPi / 2);
  const Pose pose = env.T_world_camera();
  CHECK((pose.translation() - Vector3d(1, 1, 1)).norm() < 1e-6);  // the floor is at 0, the mesh 0.2 m above it
  CHECK((env.position() - Vector3d(1, 0, 1)).norm() < 1e-6);
  CHECK(world().navmesh->snap({1, 0, 1})->y() > 0.1f);
  Pictures seen(env.config());
  env.observe(seen.targets());
  const Size size = env.config().panorama;
  const double down = radians(90.0 - 90.0 / size.height);  // latitude of the lowest row's pixel centres
  const std::size_t lowest = static_cast<std::size_t>(size.height - 1) * static_cast<std::size_t>(size.width);
  CHECK(seen.depth[lowest] * std::sin(down) == doctest::Approx(1).epsilon(1e-4));
  CHECK((-pose.linear().col(2) - Vector3d(1, 0, 0)).norm() < 1e-12);
}

TEST_CASE("outputs that are not asked for stay untouched") {
  const NavigationEnv env = env_at(1, 1, 0);
  const Pictures blank(env.config());
  Pictures all(env.config()), front(env.config());
  env.observe(all.targets());
  env.observe({.front = front.front.data()});
  CHECK(front.front == all.front);
  CHECK(front.panorama == blank.panorama);
  CHECK(front.depth == blank.depth);
  CHECK(all.panorama != blank.panorama);
}

TEST_CASE("starts off the mesh and worlds that lack a part are refused") {
  NavigationEnv env(world(), small_pictures());
  CHECK_THROWS_AS(env.reset({3, 0, 3}, 0), NavigationError);  // in the block
  CHECK_THROWS_AS(env.reset({50, 0, 50}, 0), NavigationError);
  CHECK_THROWS_AS(env.reset({1, 2, 1}, 0), NavigationError);  // no floor up there
  const double height = world().navmesh->snap({1, 0, 1})->y();
  CHECK_NOTHROW(env.reset({1, height + 0.4, 1}, 0));
  CHECK_THROWS_WITH_AS(env.reset({1, height + 0.6, 1}, 0), doctest::Contains("and 0.5 m above or below"),
                       NavigationError);
  CHECK_THROWS_WITH_AS(env.reset({1, height + 0.6, 1}, 0), doctest::Contains("m beside and 0.6 m below"),
                       NavigationError);
  CHECK_THROWS_AS(env.reset({1, 0, 1}, std::nan("")), ArgumentError);
  CHECK_THROWS_AS(env.reset({1, 0, 1}, 0, std::nan("")), ArgumentError);
  CHECK_THROWS_AS(NavigationEnv({nullptr, world().navmesh, world().ground}, {}), ArgumentError);
  CHECK_THROWS_AS(NavigationEnv({world().renderer, nullptr, world().ground}, {}), ArgumentError);
  CHECK_THROWS_AS(NavigationEnv({world().renderer, world().navmesh, nullptr}, {}), ArgumentError);
}
