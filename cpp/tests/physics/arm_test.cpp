// SPDX-License-Identifier: Apache-2.0
#include <doctest/doctest.h>

#include <cmath>
#include <limits>

#include "wiw/core/error.hpp"
#include "wiw/core/rng.hpp"
#include "wiw/physics/articulation.hpp"
#include "wiw/physics/inverse_kinematics.hpp"
#include "wiw/physics/world.hpp"

using namespace wiw;
using namespace wiw::physics;
using Eigen::Vector3d;
using Eigen::VectorXd;

namespace {

/// Crooked on purpose: fixed joints in between, origins and axes turned, inertias off their axes, a slide at the end.
const char* const kRobot = R"(<robot name="crooked">
  <link name="base"><inertial><mass value="2"/><inertia ixx="1" ixy="0" ixz="0" iyy="1" iyz="0" izz="1"/></inertial>
    <collision><geometry><box size="0.1 0.1 0.1"/></geometry></collision></link>
  <link name="upper"><inertial><origin xyz="0.05 0.02 0.1" rpy="0.3 0.2 0.1"/><mass value="1.5"/>
    <inertia ixx="0.02" ixy="0.003" ixz="0.001" iyy="0.03" iyz="-0.002" izz="0.015"/></inertial>
    <collision><origin xyz="0 0 0.15"/><geometry><cylinder radius="0.03" length="0.2"/></geometry></collision></link>
  <link name="bracket"><inertial><origin xyz="0.1 0 0"/><mass value="0.3"/>
    <inertia ixx="0.002" ixy="0" ixz="0" iyy="0.002" iyz="0.0005" izz="0.003"/></inertial></link>
  <link name="fore"><inertial><origin xyz="0 0.1 0"/><mass value="0.8"/>
    <inertia ixx="0.01" ixy="0.001" ixz="0" iyy="0.004" iyz="0" izz="0.01"/></inertial>
    <collision><origin xyz="0 0.1 0" rpy="1 0 0"/><geometry><box size="0.04 0.1 0.04"/></geometry></collision>
    <collision><origin xyz="0 0.2 0"/><geometry><sphere radius="0.03"/></geometry></collision></link>
  <link name="slide"><inertial><mass value="0.2"/><inertia ixx="1e-3" ixy="0" ixz="0" iyy="1e-3" iyz="0" izz="1e-3"/></inertial></link>
  <link name="tip"/>
  <joint name="shoulder" type="revolute"><parent link="base"/><child link="upper"/><origin xyz="0 0.1 0.2" rpy="0.1 0.2 0.3"/>
    <axis xyz="1 2 2"/><limit lower="-2" upper="2" velocity="3" effort="100"/></joint>
  <joint name="weld" type="fixed"><parent link="upper"/><child link="bracket"/><origin xyz="0.02 0 0.3" rpy="0.5 0 0.7"/></joint>
  <joint name="elbow" type="revolute"><parent link="bracket"/><child link="fore"/><origin xyz="0.1 0 0.05" rpy="0 0.4 0"/>
    <axis xyz="0 1 0"/><limit lower="-1" upper="2.5" velocity="3" effort="50"/></joint>
  <joint name="rail" type="prismatic"><parent link="fore"/><child link="slide"/><origin xyz="0 0.2 0" rpy="0 0 1"/>
    <axis xyz="0 1 1"/><limit lower="-0.1" upper="0.2" velocity="0.5" effort="40"/></joint>
  <joint name="mount" type="fixed"><parent link="slide"/><child link="tip"/><origin xyz="0 0 0.07" rpy="0 1 0"/></joint>
</robot>)";

/// A ball joint as it is usual in URDF: three hinges in one place, two links without shape or mass between them.
const char* const kBall = R"(<robot name="ball">
  <link name="base"/><link name="x"/><link name="xy"/>
  <link name="hand"><inertial><mass value="1"/><inertia ixx="0.1" ixy="0" ixz="0" iyy="0.1" iyz="0" izz="0.1"/></inertial></link>
  <joint name="roll" type="revolute"><parent link="base"/><child link="x"/><axis xyz="1 0 0"/>
    <limit lower="-1" upper="1" velocity="2" effort="200"/></joint>
  <joint name="pitch" type="revolute"><parent link="x"/><child link="xy"/><axis xyz="0 1 0"/>
    <limit lower="-1" upper="1" velocity="2" effort="200"/></joint>
  <joint name="yaw" type="revolute"><parent link="xy"/><child link="hand"/><axis xyz="0 0 1"/>
    <limit lower="-1" upper="1" velocity="2" effort="200"/></joint>
</robot>)";

VectorXd random_positions(const Articulation& robot, Rng& rng) {
  return VectorXd::NullaryExpr(
      robot.dof(), [&](Eigen::Index i) { return rng.uniform(robot.limits().lower[i], robot.limits().upper[i]); });
}

/// Kinetic and potential energy by the links' own inertials and finite differences of forward kinematics.
double energy(const World& world) {
  const Articulation& robot = *world.articulation(0);
  const VectorXd q = world.joint_positions(0), v = world.joint_velocities(0);
  const double h = 1e-6;
  const auto now = robot.forward_kinematics(q), later = robot.forward_kinematics(q + h * v);
  double sum = 0;
  for (std::size_t i = 0; i < robot.links().size(); ++i) {
    const MassProperties& body = robot.links()[i].inertial;
    const Vector3d speed = (later[i] * body.center - now[i] * body.center) / h;
    const Eigen::AngleAxisd turn(Eigen::Matrix3d(now[i].linear().transpose() * later[i].linear()));
    const Vector3d spin = turn.angle() / h * turn.axis();
    sum += 0.5 * body.mass * speed.squaredNorm() + 0.5 * spin.dot(body.inertia * spin);
    sum += 9.81 * body.mass * (now[i] * body.center).z();
  }
  return sum;
}

}  // namespace

TEST_CASE("Bullet's links stand where forward kinematics puts them") {
  const auto robot = Articulation::parse(kRobot);
  CHECK(robot->dof() == 3);
  World world;
  Pose base = Pose::Identity();
  base.translate(Vector3d(1, 2, 3)).rotate(Eigen::AngleAxisd(0.7, Vector3d(1, 2, 3).normalized()));
  world.add_articulation(robot, base);
  Rng rng(1);
  for (int i = 0; i < 50; ++i) {
    world.set_joint_positions(0, random_positions(*robot, rng));
    const auto ours = world.link_poses(0), bullets = world.simulated_link_poses(0);
    for (std::size_t link = 0; link < ours.size(); ++link) {
      REQUIRE((ours[link].matrix() - bullets[link].matrix()).cwiseAbs().maxCoeff() < 1e-9);
    }
  }
}

TEST_CASE("the Jacobian is the derivative of forward kinematics") {
  const auto robot = Articulation::parse(kRobot);
  Rng rng(2);
  const double h = 1e-6;
  for (int i = 0; i < 20; ++i) {
    const VectorXd q = random_positions(*robot, rng);
    for (const int link : {robot->link_index("tip"), robot->link_index("bracket")}) {
      const auto jacobian = robot->jacobian(q, link);
      for (int j = 0; j < robot->dof(); ++j) {
        VectorXd low = q, high = q;
        low[j] -= h, high[j] += h;
        const Pose a = robot->forward_kinematics(low)[static_cast<std::size_t>(link)];
        const Pose b = robot->forward_kinematics(high)[static_cast<std::size_t>(link)];
        const Eigen::AngleAxisd turn(Eigen::Matrix3d(b.linear() * a.linear().transpose()));
        REQUIRE((jacobian.col(j).head<3>() - (b.translation() - a.translation()) / (2 * h)).norm() < 1e-6);
        REQUIRE((jacobian.col(j).tail<3>() - turn.angle() / (2 * h) * turn.axis()).norm() < 1e-6);
      }
    }
  }
}

TEST_CASE("swinging freely, the arm keeps its energy") {
  const auto robot = Articulation::parse(kRobot);
  World world({.time_step = 1.0 / 2400});
  world.add_articulation(robot);
  world.set_joint_positions(0, Vector3d(0.3, 0.5, 0.05));
  world.set_joint_forces(0, Vector3d(0, 0, 0));
  world.set_joint_forces(0, Vector3d(0, 0, 1e4));  // the rail would run into its end
  const double before = energy(world);
  double lowest = before, highest = before, fastest = 0;
  for (int i = 0; i < 700; ++i) {
    world.step();
    const VectorXd q = world.joint_positions(0);
    if (q[0] < -1.9 || q[0] > 1.9 || q[1] < -0.9 || q[1] > 2.4) break;
    const double now = energy(world);
    lowest = std::min(lowest, now), highest = std::max(highest, now);
    fastest = std::max(fastest, world.joint_velocities(0).cwiseAbs().maxCoeff());
  }
  CHECK(fastest > 1);
  CHECK(highest - lowest < 0.02 * std::abs(before));
}

TEST_CASE("motors go where they are told, no faster than they may, and stay within the limits") {
  const auto robot = Articulation::parse(kRobot);
  World world;
  world.add_articulation(robot);
  world.set_joint_targets(0, Vector3d(2, -1, 0.2));
  for (int i = 0; i < 480; ++i) {
    world.step();
    const VectorXd speed = world.joint_velocities(0).cwiseAbs();
    REQUIRE((speed.array() <= robot->limits().velocity.array() * 1.01).all());
  }
  CHECK((world.joint_positions(0) - Vector3d(2, -1, 0.2)).norm() < 1e-3);
  world.set_joint_forces(0, VectorXd::Zero(3));
  for (int i = 0; i < 960; ++i) {
    world.step();
    const VectorXd q = world.joint_positions(0);
    for (int j = 0; j < 3; ++j) {
      REQUIRE(q[j] > robot->limits().lower[j] - 0.05);
      REQUIRE(q[j] < robot->limits().upper[j] + 0.05);
    }
  }
}

TEST_CASE("joints of links without shapes have motors and limits, and these links touch nothing") {
  World world;
  world.add_articulation(Articulation::parse(kBall));
  world.add_body({.name = "around it", .parts = {{Sphere{0.2}}}});
  world.set_joint_targets(0, Vector3d(0.5, 0.5, 0.5));
  world.step(480);
  CHECK((world.joint_positions(0) - Vector3d(0.5, 0.5, 0.5)).norm() < 1e-3);
  CHECK(world.contacts().empty());
  world.set_joint_forces(0, Vector3d::Zero());
  world.set_joint_velocities(0, Vector3d(1, -1, 1));
  world.step(960);
  CHECK(world.joint_positions(0).cwiseAbs().maxCoeff() < 1.05);
}

TEST_CASE("inverse kinematics finds poses that there are, and says why it does not find others") {
  const auto robot = Articulation::parse(kRobot);
  const int tip = robot->link_index("tip");
  const InverseKinematics ik(robot, tip);
  CHECK(ik.joints() == std::vector<int>{0, 1, 2});
  Rng rng(3);
  for (int i = 0; i < 200; ++i) {
    const VectorXd truth = random_positions(*robot, rng);
    const Pose target = robot->forward_kinematics(truth)[static_cast<std::size_t>(tip)];
    const IkResult result = ik.solve(target, VectorXd::Zero(3));
    REQUIRE(result.reached());
    const Pose reached = robot->forward_kinematics(result.joints)[static_cast<std::size_t>(tip)];
    REQUIRE((reached.translation() - target.translation()).norm() < 1e-4);
    REQUIRE(Eigen::AngleAxisd(Eigen::Matrix3d(reached.linear().transpose() * target.linear())).angle() < 1e-3);
    robot->check_within_limits(result.joints, "solution");
  }
  Pose far = Pose::Identity();
  far.translation() = Vector3d(5, 0, 0);
  const IkResult none = ik.solve(far, VectorXd::Zero(3));
  CHECK(none.reason == IkReason::kOutOfReach);
  CHECK(none.attempts == 1);
  far.translation() = Vector3d(0.1, 0.1, 0.1);
  CHECK_FALSE(ik.solve(far, VectorXd::Zero(3)).reached());
  CHECK(ik.solve(far, VectorXd::Zero(3)).joints == ik.solve(far, VectorXd::Zero(3)).joints);
  far.translation().x() = std::nan("");
  CHECK_THROWS_AS(ik.solve(far, VectorXd::Zero(3)), ArgumentError);
  CHECK_THROWS_AS(InverseKinematics(robot, 0), ArgumentError);
}

TEST_CASE("a world with arms forks and repeats to the bit") {
  const auto robot = Articulation::parse(kRobot);
  World world;
  Rng rng(4);
  world.add_articulation(robot);
  world.add_body({.parts = {{Box{{2, 2, 0.1}}}}, .T_world_body = Pose(Eigen::Translation3d(0, 0, -0.3))});
  for (int i = 0; i < 6; ++i) {
    world.add_body(
        {.parts = {{Box{{0.1, 0.1, 0.1}}}},
         .mass = 0.2,
         .T_world_body = Pose(Eigen::Translation3d(rng.uniform(-0.3, 0.3), rng.uniform(-0.3, 0.3), 0.5 + 0.2 * i))});
  }
  for (int i = 0; i < 10; ++i) {
    const VectorXd target = random_positions(*robot, rng);
    if (i == 3) world.attach(0, robot->link_index("tip"), 2);
    if (i == 6) world.attach(0, robot->link_index("fore"), 4);
    if (i == 8) world.detach(0);
    const auto fork = world.fork();
    for (World* each : {&world, fork.get()}) {
      each->set_joint_targets(0, target);
      each->step(50);
    }
    REQUIRE(fork->snapshot().numbers == world.snapshot().numbers);
    REQUIRE(fork->attachments().size() == world.attachments().size());
  }
}

TEST_CASE("restarts stay within limits that lie beyond half a turn") {
  constexpr double kInfinity = std::numeric_limits<double>::infinity();
  struct Case {
    double lower, upper, start, outside, inside;
  };
  for (const Case& each : {Case{3.5, 5, 3.5, 3.3, 4.9}, Case{-5, -3.5, -3.5, -3.3, -4.9},
                           Case{3.5, kInfinity, 3.5, 3.3, 4.9}, Case{-kInfinity, -3.5, -3.5, -3.3, -4.9}}) {
    const auto number = [](double value) { return VectorXd::Constant(1, value); };
    std::vector<Link> links{{.name = "base"}, {.name = "tip"}};
    std::vector<Joint> joints{
        {.name = "j", .type = JointType::kRevolute, .axis = Eigen::Vector3d::UnitZ(), .index = 0}};
    const auto robot =
        std::make_shared<Articulation>("turned", std::move(links), std::move(joints),
                                       JointLimits{number(each.lower), number(each.upper), number(1), number(1)});
    const InverseKinematics ik(robot, 1);
    const auto turned = [](double angle) { return Pose(Eigen::AngleAxisd(angle, Vector3d::UnitZ())); };
    const IkResult none = ik.solve(turned(each.outside), number(each.start), {.rotation_tolerance = 0.15});
    CHECK(none.reached() == (each.upper - each.lower == kInfinity));  // a turn further on
    CHECK(none.joints[0] >= each.lower);
    CHECK(none.joints[0] <= each.upper);
    const IkResult found = ik.solve(turned(each.inside), number(each.start));
    CHECK(found.reached());
    CHECK(found.joints[0] == doctest::Approx(each.inside).epsilon(1e-3));
  }
}
