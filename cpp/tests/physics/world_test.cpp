// SPDX-License-Identifier: Apache-2.0
#include "wiw/physics/world.hpp"

#include <doctest/doctest.h>

#include <cmath>
#include <thread>

#include "wiw/core/error.hpp"
#include "wiw/core/intrinsics.hpp"
#include "wiw/core/rng.hpp"

using namespace wiw;
using namespace wiw::physics;
using Eigen::Vector3d;

namespace {

Pose at(double x, double y, double z) {
  Pose pose = Pose::Identity();
  pose.translation() = Vector3d(x, y, z);
  return pose;
}

int add(World& world, const Shape& shape, double mass, const Pose& pose) {
  return world.add_body({.parts = {{shape}}, .mass = mass, .T_world_body = pose});
}

int add_table(World& world) { return add(world, Box{{2, 2, 0.1}}, 0, at(0, 0, -0.05)); }

/// Things of every shape that fall into a heap.
std::unique_ptr<World> heap(std::uint64_t seed) {
  auto world = std::make_unique<World>();
  add_table(*world);
  Rng rng(fold_key({seed}));
  ConvexHull hull;
  for (int i = 0; i < 20; ++i)
    hull.points.emplace_back(rng.uniform(-0.03, 0.03), rng.uniform(-0.03, 0.03), rng.uniform(-0.03, 0.03));
  const Part lid{Cylinder{0.03, 0.01}, at(0, 0, 0.03)};
  for (int i = 0; i < 12; ++i) {
    const Pose pose = at(rng.uniform(-0.05, 0.05), rng.uniform(-0.05, 0.05), 0.05 + 0.05 * i);
    const std::array<Shape, 5> shapes{Box{{0.04, 0.05, 0.03}}, Sphere{0.02}, Cylinder{0.02, 0.05}, Capsule{0.015, 0.04},
                                      hull};
    Body body{.parts = {{shapes[static_cast<std::size_t>(i) % 5]}}, .mass = 0.1, .T_world_body = pose};
    if (i % 4 == 3) body.parts.push_back(lid);
    world->add_body(body);
  }
  return world;
}

}  // namespace

TEST_CASE("a body falls as Galileo says, and a throw keeps its energy") {
  World world;
  const int ball = add(world, Sphere{0.1}, 1, at(0, 0, 10));
  world.set_body_velocity(ball, (Vector6() << 1, 0, 2, 0, 0, 3).finished());
  world.step(240);
  const Pose pose = world.body_poses()[0];
  // Semi-implicit Euler falls g t dt / 2 further than the parabola.
  CHECK(pose.translation().z() == doctest::Approx(10 + 2 - 9.81 / 2 * (1 + 1.0 / 240)).epsilon(1e-9));
  CHECK(pose.translation().x() == doctest::Approx(1).epsilon(1e-9));
  CHECK(world.body_velocities()[0][5] == doctest::Approx(3).epsilon(1e-6));
  CHECK(world.time() == doctest::Approx(1));
}

TEST_CASE("a lopsided body turns about its centre of mass") {
  World world({.gravity = Vector3d::Zero()});
  const Body hammer{.parts = {{Box{{0.3, 0.02, 0.02}}, at(0.15, 0, 0)}, {Box{{0.04, 0.1, 0.04}}, at(0.3, 0, 0)}},
                    .mass = 1};
  const Vector3d center = mass_properties(hammer.parts, 1).center;
  world.set_body_velocity(world.add_body(hammer), (Vector6() << 0, 0, 0, 0, 0, 2).finished());
  world.step(500);
  const Pose pose = world.body_poses()[0];
  CHECK((pose * center - center).norm() < 1e-6);
  CHECK(std::abs(std::atan2(pose(1, 0), pose(0, 0))) > 0.5);
}

TEST_CASE("fast things do not fall through thin ones") {
  for (const Shape& shape : {Shape(Sphere{0.02}), Shape(Box{{0.04, 0.04, 0.04}}), Shape(Cylinder{0.02, 0.04})}) {
    World world;
    add(world, Box{{1, 1, 0.02}}, 0, at(0, 0, -0.01));
    const int body = add(world, shape, 0.1, at(0, 0, 0.2));
    world.set_body_velocity(body, (Vector6() << 0, 0, -3, 0, 0, 0).finished());
    for (int i = 0; i < 240; ++i) {
      world.step();
      REQUIRE(world.body_poses()[1].translation().z() > 0.005);
    }
    CHECK(world.body_poses()[1].translation().z() == doctest::Approx(0.02).epsilon(0.01));
  }
}

TEST_CASE("friction, the product of both surfaces', holds up to its angle") {
  for (const double slope : {0.3, 0.4}) {  // tangents 0.31 and 0.42 on either side of 0.6 squared
    World world({.gravity = 9.81 * Vector3d(std::sin(slope), 0, -std::cos(slope))});
    world.add_body({.parts = {{Box{{2, 2, 0.1}}}}, .friction = 0.6, .T_world_body = at(0, 0, -0.05)});
    world.add_body(
        {.parts = {{Box{{0.04, 0.04, 0.02}}}}, .mass = 0.1, .friction = 0.6, .T_world_body = at(0, 0, 0.01)});
    world.step(240);
    const double slid = world.body_poses()[1].translation().x();
    const double expected = 9.81 / 2 * std::max(0.0, std::sin(slope) - 0.36 * std::cos(slope));
    CHECK(slid == doctest::Approx(expected).epsilon(0.05).scale(0.05));
  }
}

TEST_CASE("the same world gives the same bits, run by run and thread by thread") {
  std::vector<WorldState> ends(6);
  for (std::size_t i = 0; i < 3; ++i) {
    const auto world = heap(1);
    world->step(300);
    ends[i] = world->snapshot();
  }
  std::vector<std::thread> threads;
  for (std::size_t i = 3; i < 6; ++i) {
    threads.emplace_back([&ends, i] {
      const auto world = heap(1);
      for (int k = 0; k < 300; ++k) world->step();
      ends[i] = world->snapshot();
    });
  }
  for (std::thread& thread : threads) thread.join();
  for (const WorldState& end : ends) CHECK(end.numbers == ends[0].numbers);
  const auto other = heap(2);
  other->step(300);
  CHECK(other->snapshot().numbers != ends[0].numbers);
}

TEST_CASE("a recording has every step since, and changes none") {
  const auto world = heap(3), other = heap(3);
  world->step(5);
  other->step(5);
  CHECK(world->recorded().empty());
  world->record();
  CHECK(world->fork()->recorded().empty());
  world->step(20);
  other->step(20);
  world->step();
  const std::vector<WorldState> states = world->recorded();
  REQUIRE(states.size() == 22);
  for (std::size_t i = 0; i < states.size(); ++i) CHECK(states[i].steps == static_cast<std::int64_t>(5 + i));
  CHECK(states[20].numbers == other->snapshot().numbers);
  world->step();
  CHECK(world->recorded().empty());
}

TEST_CASE("forks and restored snapshots go on as the original does, at any moment") {
  const auto world = heap(3);
  for (int moment = 0; moment < 12; ++moment) {
    world->step(17);
    const WorldState now = world->snapshot();
    const auto fork = world->fork();
    CHECK(fork->snapshot().numbers == now.numbers);
    CHECK(world->contacts(-1).empty());  // looking changes nothing
    world->step(40);
    fork->step(40);
    REQUIRE(fork->snapshot().numbers == world->snapshot().numbers);
    const WorldState then = world->snapshot();
    fork->set_body_pose(3, at(0.2, 0.2, 0.2));
    fork->step(30);
    world->restore(now);
    world->step(40);
    REQUIRE(world->snapshot().numbers == then.numbers);
    fork->restore(now);
    fork->step(40);
    REQUIRE(fork->snapshot().numbers == then.numbers);
  }
}

TEST_CASE("contacts name what touches, where, and how deep") {
  World world;
  const int table = add_table(world);
  const int cube = add(world, Box{{0.04, 0.04, 0.04}}, 0.1, at(0.3, 0, 0.019));
  add(world, Sphere{0.02}, 0.1, at(0, 0, 0.5));
  const std::vector<Contact> contacts = world.contacts();
  REQUIRE(contacts.size() == 4);
  for (const Contact& contact : contacts) {
    CHECK((contact.a.body == cube || contact.b.body == cube));
    CHECK((contact.a.body == table || contact.b.body == table));
    CHECK(contact.distance == doctest::Approx(-0.001).epsilon(1e-6));
    CHECK(contact.normal.z() == doctest::Approx(contact.a.body == cube ? 1 : -1));
    CHECK(std::abs(contact.position.x() - 0.3) == doctest::Approx(0.02));
  }
  world.set_body_pose(cube, at(0.3, 0, 0.025));
  CHECK(world.contacts().empty());
  world.set_body_pose(2, at(0.3, 0.3, 0.0203));
  CHECK(world.contacts().empty());
  REQUIRE(world.contacts(0.001).size() == 1);
  CHECK(world.contacts(0.001)[0].distance == doctest::Approx(0.0003).epsilon(1e-3));
  world.set_body_pose(table, at(0, 0, -0.5));
  CHECK(world.contacts(0.01).empty());
}

TEST_CASE("bad numbers are refused and leave the world as it was") {
  World world;
  add_table(world);
  const int cube = add(world, Box{{0.04, 0.04, 0.04}}, 0.1, at(0, 0, 0.02));
  const WorldState before = world.snapshot();
  Pose bad = Pose::Identity();
  bad.translation().x() = std::nan("");
  CHECK_THROWS_AS(world.set_body_pose(cube, bad), ArgumentError);
  CHECK_THROWS_AS(world.set_body_pose(7, Pose::Identity()), ArgumentError);
  CHECK_THROWS_AS(world.set_body_velocity(0, Vector6::Zero()), ArgumentError);
  CHECK_THROWS_AS(world.set_body_velocity(cube, Vector6::Constant(std::nan(""))), ArgumentError);
  CHECK_THROWS_AS(add(world, Sphere{0.1}, -1, at(0, 0, 1)), ArgumentError);
  CHECK_THROWS_AS(add(world, Sphere{0.1}, std::nan(""), at(0, 0, 1)), ArgumentError);
  CHECK_THROWS_AS(world.add_body({}), ArgumentError);
  CHECK_THROWS_AS(world.step(-1), ArgumentError);
  CHECK_THROWS_AS((void)world.contacts(std::nan("")), ArgumentError);
  CHECK_THROWS_AS(World({.time_step = 0}), ArgumentError);
  CHECK_THROWS_AS(heap(1)->restore(before), ArgumentError);
  CHECK(world.snapshot().numbers == before.numbers);
  CHECK(world.body_count() == 2);
}

TEST_CASE("rods and discs as thin as one likes come to lie on the floor") {
  const Pose lying(Eigen::AngleAxisd(kPi / 2, Eigen::Vector3d::UnitX()));
  const Pose level = Pose::Identity();
  const auto rod = [](double width) {
    ConvexHull hull;
    for (int i = 0; i < 8; ++i) {
      hull.points.emplace_back(i & 1 ? width : -width, i & 2 ? width : -width, i & 4 ? 0.5 : -0.5);
    }
    return hull;
  };
  const auto end_of = [](const Part& thing) {
    World world;
    add(world, Box{{10, 10, 1}}, 0, at(0, 0, -0.5));
    world.add_body({.parts = {thing}, .mass = 0.1, .T_world_body = at(0, 0, 0.01)});
    world.step(240);
    return Vector3d(world.body_poses()[1].translation());
  };
  for (const Part& thing :
       {Part{Cylinder{0.0005, 1}, lying}, Part{Cylinder{1e-5, 1}, lying}, Part{Cylinder{0.5, 0.0005}, level},
        Part{Cylinder{0.5, 1e-9}, level}, Part{rod(0.0005), lying}, Part{rod(1e-5), lying}}) {
    const Vector3d end = end_of(thing);
    CHECK(std::abs(end.z()) < 0.005);
    CHECK(end.head<2>().norm() < 1);
  }
  CHECK(end_of({Cylinder{1e-9, 1}, lying}).allFinite());  // too thin to be kept out of the floor
}
