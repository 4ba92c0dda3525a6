// SPDX-License-Identifier: Apache-2.0
#include <pybind11/eigen.h>
#include <pybind11/numpy.h>
#include <pybind11/pybind11.h>
#include <pybind11/stl.h>
#include <pybind11/stl/filesystem.h>

#include "arrays.hpp"
#include "gil.hpp"
#include "physics_arrays.hpp"
#include "wiw/physics/gripper.hpp"
#include "wiw/physics/inverse_kinematics.hpp"
#include "wiw/physics/linear_path.hpp"
#include "wiw/physics/world.hpp"

namespace py = pybind11;
using namespace wiw;
using namespace wiw::physics;
using wiw::bindings::Array;
using wiw::bindings::pose_array;
using wiw::bindings::to_pose;

void bind_physics_articulation(py::module_& module);

namespace {

using Unlocked = py::call_guard<wiw::bindings::GilRelease>;

/// One part: a shape in the body's own frame, or (shape, T_body_part).
Part to_part(const py::handle& value) {
  if (py::isinstance<py::tuple>(value) && py::len(value) == 2) {
    const auto pair = value.cast<std::pair<Shape, Array<double>>>();
    return {pair.first, to_pose(pair.second, "T_body_part")};
  }
  return {value.cast<Shape>()};
}

int add_body(World& world, const py::object& shape, double mass, const Array<double>& pose, const std::string& name,
             double friction, double restitution) {
  Body body{.name = name, .mass = mass, .friction = friction, .restitution = restitution};
  if (py::isinstance<py::list>(shape)) {
    for (const py::handle part : shape) body.parts.push_back(to_part(part));
  } else {
    body.parts.push_back(to_part(shape));
  }
  body.T_world_body = to_pose(pose, "T_world_body");
  const bindings::GilRelease release;
  return world.add_body(body);
}

py::array_t<double> body_velocities(const World& world) {
  const std::vector<Vector6> velocities = world.body_velocities();
  py::array_t<double> array({static_cast<py::ssize_t>(velocities.size()), py::ssize_t{6}});
  double* out = array.mutable_data();
  for (const Vector6& velocity : velocities) out = std::copy(velocity.begin(), velocity.end(), out);
  return array;
}

py::array_t<double> path_joints(const LinearPath& path) {
  const Eigen::Index dof = path.joints.empty() ? 0 : path.joints[0].size();
  py::array_t<double> array({static_cast<py::ssize_t>(path.joints.size()), dof});
  double* out = array.mutable_data();
  for (const Eigen::VectorXd& each : path.joints) out = std::copy(each.begin(), each.end(), out);
  return array;
}

LinearPath plan(World& world, const Array<double>& pose, int articulation, const std::string& link,
                const Touchable& allowed, const LinearPathOptions& options) {
  const Pose target = to_pose(pose, "T_world_link");
  const wiw::bindings::GilRelease release;
  const int index = world.articulation(articulation)->link_index(link);
  return plan_linear(world, articulation, index, target, allowed, options);
}

/// Numbers first, the articulation, which is nearly always the only one, last.
template <auto method>
void swapped(World& world, const Eigen::VectorXd& values, int articulation) {
  (world.*method)(articulation, values);
}

void bind_shapes(py::module_& module) {
  py::class_<Box>(module, "Box", "A box centred at its frame.")
      .def(py::init([](const Eigen::Vector3d& size) { return Box{size}; }), py::arg("size"),
           "`size`: edges [3], metres.")
      .def_readonly("size", &Box::size);
  py::class_<Sphere>(module, "Sphere", "A ball centred at its frame.")
      .def(py::init([](double radius) { return Sphere{radius}; }), py::arg("radius"))
      .def_readonly("radius", &Sphere::radius);
  py::class_<Cylinder>(module, "Cylinder", "A cylinder along z, centred at its frame.")
      .def(py::init([](double radius, double length) { return Cylinder{radius, length}; }), py::arg("radius"),
           py::arg("length"))
      .def_readonly("radius", &Cylinder::radius)
      .def_readonly("length", &Cylinder::length);
  py::class_<Capsule>(module, "Capsule", "A cylinder along z with a half ball at each end; `length` is the cylinder's.")
      .def(py::init([](double radius, double length) { return Capsule{radius, length}; }), py::arg("radius"),
           py::arg("length"))
      .def_readonly("radius", &Capsule::radius)
      .def_readonly("length", &Capsule::length);
  py::class_<ConvexHull>(module, "ConvexHull", "The convex hull of points [N, 3].")
      .def(py::init([](const Array<double>& points) {
             bindings::expect_shape(points, {-1, 3}, "points [N, 3]");
             ConvexHull hull;
             for (py::ssize_t i = 0; i < points.shape(0); ++i) hull.points.emplace_back(points.data(i, 0));
             return hull;
           }),
           py::arg("points"))
      .def_property_readonly("points", [](const ConvexHull& self) {
        py::array_t<double> array({static_cast<py::ssize_t>(self.points.size()), py::ssize_t{3}});
        double* out = array.mutable_data();
        for (const Eigen::Vector3d& point : self.points) out = std::copy(point.begin(), point.end(), out);
        return array;
      });
}

void bind_contacts(py::module_& module) {
  py::class_<ContactSide>(module, "ContactSide", "A body, or a link of an articulation, by index; the rest is -1.")
      .def_readonly("body", &ContactSide::body)
      .def_readonly("articulation", &ContactSide::articulation)
      .def_readonly("link", &ContactSide::link);
  py::class_<Contact>(module, "Contact", "Two surfaces that touch, or nearly do.")
      .def_readonly("a", &Contact::a)
      .def_readonly("b", &Contact::b)
      .def_property_readonly(
          "position", [](const Contact& self) { return self.position; }, "float64 [3], on b, world.")
      .def_property_readonly(
          "normal", [](const Contact& self) { return self.normal; }, "Unit [3], from b towards a.")
      .def_readonly("distance", &Contact::distance, "Metres, negative where they overlap.");
}

void bind_path(py::module_& module) {
  py::class_<LinearPath>(module, "LinearPath", "A straight way of a link, by World.plan_linear.")
      .def_property_readonly(
          "reason", [](const LinearPath& self) { return reason_text(self.reason); },
          "'free', or why not to the end: 'out of reach', 'joint limits', 'not converged', 'jump' "
          "(the arm would have to flip) or 'collision'.")
      .def_property_readonly("free", &LinearPath::free, "Share of the way that is free, in [0, 1].")
      .def_property_readonly("joints", &path_joints, "float64 [M, dof]: the free waypoints, the start first.")
      .def_readonly("waypoints", &LinearPath::waypoints, "Number of waypoints of the whole way.")
      .def_readonly("contact", &LinearPath::contact, "The Contact that ends the way, or None.");
}

void bind_bodies(py::class_<World>& world) {
  world.def("add_body", &add_body, py::arg("shape"), py::kw_only(), py::arg("mass") = 0.0,
            py::arg("T_world_body") = pose_array(Pose::Identity()), py::arg("name") = "", py::arg("friction") = 0.5,
            py::arg("restitution") = 0.0,
            "Adds a body and returns its index, from 0. `shape` is one shape or a list of parts, each a shape or "
            "(shape, T_body_part [4, 4]); `mass` in kg is spread evenly over their volume, 0 makes it static. "
            "ArgumentError for impossible numbers.");
  world.def(
      "body_poses", [](const World& self) { return pose_array(self.body_poses()); },
      "float64 [N, 4, 4]: T_world_body of all bodies.");
  world.def("body_velocities", &body_velocities, "float64 [N, 6]: linear above angular velocity of all bodies.");
  world.def(
      "set_body_pose",
      [](World& self, int body, const Array<double>& pose) { self.set_body_pose(body, to_pose(pose, "T_world_body")); },
      py::arg("body"), py::arg("T_world_body"), "Puts a body somewhere, at rest.");
  world.def("set_body_velocity", &World::set_body_velocity, py::arg("body"), py::arg("velocity"),
            "Linear and angular velocity [6] of a dynamic body.");
  world.def("body_name", [](const World& self, int body) { return self.body(body).name; }, py::arg("body"));
  world.def_property_readonly("bodies", &World::body_count, "Number of bodies.");
}

void bind_articulated(py::class_<World>& world) {
  const py::arg_v first = py::arg("articulation") = 0;
  world.def(
      "add_articulation",
      [](World& self, const ArticulationPtr& articulation, const Array<double>& pose) {
        const Pose base = to_pose(pose, "T_world_base");
        const bindings::GilRelease release;
        return self.add_articulation(articulation, base);
      },
      py::arg("articulation").none(false), py::arg("T_world_base") = pose_array(Pose::Identity()),
      "Adds an Articulation on a fixed base and returns its index, from 0. Its joints start at the positions nearest "
      "to "
      "zero that the limits allow.");
  world.def("joint_positions", &World::joint_positions, first, "float64 [dof]: radians or metres.");
  world.def("joint_velocities", &World::joint_velocities, first, "float64 [dof]: a second.");
  world.def("joint_targets", &World::joint_targets, first, "float64 [dof]: where the motors go.");
  world.def("joint_forces", &World::joint_forces, first, "float64 [dof]: what the motors may exert, Nm or N.");
  world.def("set_joint_positions", swapped<&World::set_joint_positions>, py::arg("positions"), first,
            "Puts the joints somewhere within their limits, at rest, with their targets there. Held bodies stay where "
            "they are, and the next steps would pull them to the link: detach them before, or put them where they "
            "belong after.");
  world.def("set_joint_velocities", swapped<&World::set_joint_velocities>, py::arg("velocities"), first);
  world.def(
      "set_joint_targets", swapped<&World::set_joint_targets>, py::arg("targets"), first,
      "Where the motors go from the next step on: each step closes 0.2 of the way, at most at the joint's velocity "
      "limit and with at most its force. ArgumentError for NaN and targets outside the limits.");
  world.def("set_joint_forces", swapped<&World::set_joint_forces>, py::arg("forces"), first,
            "What the motors may exert, Nm or N; 0 lets a joint swing freely.");
  world.def(
      "link_poses", [](const World& self, int index) { return pose_array(self.link_poses(index)); }, first,
      "float64 [L, 4, 4]: T_world_link of every link, by forward kinematics.");
  world.def(
      "simulated_link_poses", [](const World& self, int index) { return pose_array(self.simulated_link_poses(index)); },
      first, "The same as Bullet holds them, for comparison.");
  world.def(
      "attach",
      [](World& self, const std::string& link, int body, int articulation) {
        self.attach(articulation, self.articulation(articulation)->link_index(link), body);
      },
      py::arg("link"), py::arg("body"), first, "Holds a dynamic body by a link, where both are now.");
  world.def("detach", &World::detach, first, "Lets go of every body that the articulation holds.");
}

void bind_world(py::module_& module) {
  py::class_<WorldState>(module, "WorldState", "Everything that changes in a world, by World.snapshot.")
      .def_readonly("steps", &WorldState::steps)
      .def_property_readonly("numbers", [](const WorldState& self) {
        return py::array_t<double>(static_cast<py::ssize_t>(self.numbers.size()), self.numbers.data());
      });
  py::class_<World> world(module, "World", R"(Bodies and articulations under gravity and contact.

Bullet in double precision at a fixed time step; metres, kilograms, seconds, z up. The next state is a function of the
present one and the commands, to the last bit: forks and restored snapshots go on exactly as the original does. One
thread at a time may use a world; different worlds are independent, and stepping releases the GIL.

`iterations` bounds the solver's; a group of touching things is solved once its squared velocity error is below
`residual`. Links of one articulation do not collide with each other; with everything else they do.)");
  world.def(py::init([](const Eigen::Vector3d& gravity, double time_step, int iterations, double residual) {
              return std::make_unique<World>(WorldOptions{gravity, time_step, iterations, residual});
            }),
            py::kw_only(), py::arg("gravity") = WorldOptions{}.gravity, py::arg("time_step") = WorldOptions{}.time_step,
            py::arg("iterations") = WorldOptions{}.iterations, py::arg("residual") = WorldOptions{}.residual);
  world.def_property_readonly("time", &World::time, "Seconds.");
  world.def_property_readonly("time_step", [](const World& self) { return self.options().time_step; }, "Seconds.");
  world.def("step", &World::step, py::arg("count") = 1, Unlocked(), "Advances by whole time steps.");
  world.def(
      "contacts", &World::contacts, py::arg("distance") = 0.0, Unlocked(),
      "Contacts where things are now: surfaces that overlap, or are at most `distance` metres apart. Nothing further "
      "apart than 2 % of its size is looked at, and two boxes are seen only where they overlap.");
  world.def("snapshot", &World::snapshot, "The state, as a WorldState.");
  world.def("restore", &World::restore, py::arg("state"),
            "Goes back to a snapshot of this world, or of one built by the same calls; ArgumentError for others.");
  world.def("record", &World::record, "From now on keeps a snapshot of every step, the present state first.");
  world.def("recorded", &World::recorded, "What `record` kept, oldest first, as WorldStates; ends the recording.");
  world.def("fork", &World::fork, Unlocked(), "An independent world in the same state; shapes are shared.");
  bind_bodies(world);
  bind_articulated(world);
  const LinearPathOptions defaults;
  world.def(
      "plan_linear",
      [](World& self, const Array<double>& pose, const std::string& link, int articulation,
         const std::vector<int>& allowed, const std::vector<int>& allowed_articulations, double step, double angle_step,
         double tolerance) {
        return plan(self, pose, articulation, link, {allowed, allowed_articulations},
                    {.step = step, .angle_step = angle_step, .tolerance = tolerance});
      },
      py::arg("T_world_link"), py::arg("link"), py::arg("articulation") = 0, py::kw_only(),
      py::arg("allowed") = std::vector<int>{}, py::arg("allowed_articulations") = std::vector<int>{},
      py::arg("step") = defaults.step, py::arg("angle_step") = defaults.angle_step,
      py::arg("tolerance") = defaults.tolerance,
      "The straight way of a link to a pose [4, 4], as a LinearPath: inverse kinematics every `step` metres and "
      "`angle_step` radians, then a check of the arm, and of what it holds, for overlaps of more than `tolerance` "
      "metres with anything but the `allowed` bodies and `allowed_articulations`. What it overlaps at the start it may "
      "go on to, no deeper. The state stays as it is.");
  world.def(
      "follow",
      [](World& self, const LinearPath& path, int articulation, double speed, double tolerance, int settle) {
        return physics::follow(self, articulation, path, speed, tolerance, settle);
      },
      py::arg("path"), py::arg("articulation") = 0, py::kw_only(), py::arg("speed") = 0.5, py::arg("tolerance") = 1e-3,
      py::arg("settle") = 240, Unlocked(),
      "Drives the arm along a LinearPath at `speed` times its velocity limits, then waits until it stands within "
      "`tolerance` of the end, at most `settle` steps. Returns whether it does.");
}

void bind_gripper(py::module_& module) {
  const GripperNames names;
  py::class_<Gripper>(module, "Gripper", R"(Two fingers that grasp, by default the Panda's.

They close with contact; when both touch the same dynamic body, a constraint holds it and the fingers go on pressing with
`force` newtons each. All state lies in the world: a fork takes a Gripper of its own.)")
      .def(py::init([](World& world, int articulation, const std::array<std::string, 2>& joints,
                       const std::array<std::string, 2>& fingers, const std::string& hand, double force) {
             return std::make_unique<Gripper>(world, articulation, GripperNames{joints, fingers, hand}, force);
           }),
           py::keep_alive<1, 2>(), py::arg("world"), py::arg("articulation") = 0, py::kw_only(),
           py::arg("joints") = names.joints, py::arg("fingers") = names.fingers, py::arg("hand") = names.hand,
           py::arg("force") = 20.0)
      .def("close", &Gripper::close, py::arg("steps") = 480, Unlocked(),
           "Closes until the fingers stand still, at most `steps`; the index of the body that is held now, or None.")
      .def("open", &Gripper::open, py::arg("amount") = 1.0, py::arg("steps") = 480, Unlocked(),
           "Lets go and opens to `amount` of the way, in [0, 1].")
      .def_property_readonly("opening", &Gripper::opening, "Of the way from closed to open, in [0, 1].")
      .def_property_readonly("held", &Gripper::held, "Index of the body that is held, or None.")
      .def("find_body_between_fingers", &Gripper::find_body_between_fingers,
           "Index of the dynamic body that both fingers touch, or None.");
}

}  // namespace

void bind_physics(py::module_& module) {
  bind_shapes(module);
  bind_contacts(module);
  bind_physics_articulation(module);
  bind_path(module);
  bind_world(module);
  bind_gripper(module);
}
