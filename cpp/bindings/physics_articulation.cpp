// SPDX-License-Identifier: Apache-2.0
#include <pybind11/eigen.h>
#include <pybind11/numpy.h>
#include <pybind11/pybind11.h>
#include <pybind11/stl.h>
#include <pybind11/stl/filesystem.h>

#include <set>

#include "arrays.hpp"
#include "gil.hpp"
#include "physics_arrays.hpp"
#include "physics_parts.hpp"
#include "wiw/physics/articulation.hpp"
#include "wiw/physics/inverse_kinematics.hpp"
#include "wiw/physics/mesh_file.hpp"

namespace py = pybind11;
using namespace wiw;
using namespace wiw::physics;
using wiw::bindings::Array;
using wiw::bindings::pose_array;
using wiw::bindings::to_pose;

namespace {

std::vector<std::string> link_names(const Articulation& articulation) {
  std::vector<std::string> names;
  for (const Link& link : articulation.links()) names.push_back(link.name);
  return names;
}

py::list visuals(const Articulation& articulation) {
  py::list all;
  for (std::size_t link = 0; link < articulation.links().size(); ++link) {
    for (const Visual& visual : articulation.links()[link].visual) {
      py::dict each;
      each["link"] = link;
      each["shape"] = visual.shape ? py::cast(*visual.shape) : py::none();
      each["mesh"] = visual.mesh.empty() ? py::none() : py::cast(visual.mesh);
      each["scale"] = visual.scale;
      each["T_link_visual"] = pose_array(visual.pose);
      each["color"] = visual.color;
      all.append(each);
    }
  }
  return all;
}

template <class Row>
py::array rows(const std::vector<Row>& values) {
  using Number = Row::Scalar;
  py::array_t<Number> array({static_cast<py::ssize_t>(values.size()), py::ssize_t{Row::RowsAtCompileTime}});
  Number* out = array.mutable_data();
  for (const Row& row : values) out = std::copy(row.begin(), row.end(), out);
  return array;
}

py::dict read_surface(const std::filesystem::path& path, const Eigen::Vector3d& scale, const std::string& link) {
  const VisualMesh surface = [&] {
    const wiw::bindings::GilRelease release;
    return surface_of_file(path, scale, link);
  }();
  py::dict all;
  all["positions"] = rows(surface.positions);
  all["normals"] = rows(surface.normals);
  all["colors"] = rows(surface.colors);
  all["triangles"] = rows(surface.triangles);
  return all;
}

std::vector<std::filesystem::path> mesh_files(const Articulation& articulation) {
  std::set<std::filesystem::path> files;
  for (const Link& link : articulation.links()) files.insert(link.meshes.begin(), link.meshes.end());
  return {files.begin(), files.end()};
}

py::list tree(const Articulation& articulation) {
  py::list all;
  for (std::size_t i = 0; i < articulation.joints().size(); ++i) {
    const Joint& joint = articulation.joints()[i];
    const bool slides = joint.type == JointType::kPrismatic;
    py::dict each;
    each["name"] = joint.name;
    each["type"] = joint.type == JointType::kFixed ? "fixed" : slides ? "prismatic" : "revolute";
    each["parent"] = articulation.links()[static_cast<std::size_t>(joint.parent)].name;
    each["child"] = articulation.links()[i + 1].name;
    each["mimics"] = joint.mimic ? articulation.movable_joints()[static_cast<std::size_t>(joint.mimic->index)] : "";
    all.append(each);
  }
  return all;
}

py::dict limits(const Articulation& articulation) {
  const JointLimits& from = articulation.limits();
  py::dict all;
  all["lower"] = from.lower;
  all["upper"] = from.upper;
  all["velocity"] = from.velocity;
  all["effort"] = from.effort;
  return all;
}

IkResult solve(const InverseKinematics& ik, const Array<double>& pose, const Eigen::VectorXd& start,
               double position_tolerance, double rotation_tolerance, int iterations, int restarts, std::uint64_t seed) {
  const Pose target = to_pose(pose, "T_base_link");
  const wiw::bindings::GilRelease release;
  return ik.solve(target, start, {position_tolerance, rotation_tolerance, iterations, restarts, seed});
}

void bind_kinematics(py::module_& module) {
  py::class_<IkResult>(module, "IkResult", "Joint positions for a pose, or why there are none.")
      .def_property_readonly("reached", &IkResult::reached)
      .def_property_readonly(
          "reason", [](const IkResult& self) { return reason_text(self.reason); },
          "'reached', 'out of reach' (further than the arm is long), 'joint limits' (the best attempt "
          "stands at one) or 'not converged'.")
      .def_property_readonly(
          "joints", [](const IkResult& self) { return self.joints; },
          "float64 [dof]; of the best attempt where the pose is not reached.")
      .def_readonly("position_error", &IkResult::position_error, "Metres.")
      .def_readonly("rotation_error", &IkResult::rotation_error, "Radians.")
      .def_readonly("iterations", &IkResult::iterations, "Of all attempts together.")
      .def_readonly("attempts", &IkResult::attempts);
  const IkOptions defaults;
  py::class_<InverseKinematics>(module, "InverseKinematics", R"(Joint positions that bring a link to a pose.

Damped least squares with joint limits. The first attempt starts from `start`, which keeps the arm near where it is; up to
`restarts` more start from random positions that depend on `seed` alone. Immutable; may be shared between threads.)")
      .def(py::init([](const ArticulationPtr& articulation, const std::string& link) {
             return std::make_unique<InverseKinematics>(articulation, articulation->link_index(link));
           }),
           py::arg("articulation").none(false), py::arg("link"))
      .def("__call__", &solve, py::arg("T_base_link"), py::arg("start"), py::kw_only(),
           py::arg("position_tolerance") = defaults.position_tolerance,
           py::arg("rotation_tolerance") = defaults.rotation_tolerance, py::arg("iterations") = defaults.iterations,
           py::arg("restarts") = defaults.restarts, py::arg("seed") = defaults.seed,
           "An IkResult for a pose [4, 4] in the frame of the base. ArgumentError for NaN or a matrix that is not "
           "rigid.")
      .def_property_readonly("joints", &InverseKinematics::joints, "Indices of the joints that move the link.");
}

}  // namespace

void bind_physics_articulation(py::module_& module) {
  py::class_<Articulation, std::shared_ptr<Articulation>>(module, "Articulation", R"(A tree of links on a fixed base.

Read from a URDF: kinematics, inertias, limits, collision shapes (meshes as their convex hulls) and looks. Joints are
fixed, revolute, continuous or prismatic; the motor of a joint with `mimic` follows the target of the one it names. Damping
and friction are not read: motors set velocities. Link 0 is the base. Immutable; may be
shared between worlds and threads.)")
      .def(py::init([](const std::filesystem::path& path) {
             // A guard of the whole call would go on while pybind11 registers the object, which takes the lock.
             const wiw::bindings::GilRelease release;
             return std::const_pointer_cast<Articulation>(Articulation::load(path));
           }),
           py::arg("path"),
           "Reads a URDF file. FileError for a file or mesh that is missing or damaged (the message names the link), "
           "ArgumentError for impossible numbers and other joints. `package://NAME/...` is looked for in the folders "
           "above the file. It is read in this process; `wiw.tabletop.robot.robot_of` reads files of others in one of "
           "its own.")
      .def_static(
          "from_text",
          [](const std::string& urdf, const std::filesystem::path& folder) {
            return std::const_pointer_cast<Articulation>(Articulation::parse(urdf, folder));
          },
          py::arg("urdf"), py::arg("folder") = std::filesystem::path(), py::call_guard<wiw::bindings::GilRelease>(),
          "The same from text; mesh files are relative to `folder`.")
      .def("to_parts", &bindings::articulation_to_parts,
           "All of it as plain data that JSON can hold to the last bit, for `from_parts`.")
      .def_static(
          "from_parts",
          [](const py::dict& parts) {
            return std::const_pointer_cast<Articulation>(bindings::articulation_from_parts(parts));
          },
          py::arg("parts"),
          "The articulation whose `to_parts` this is. ArgumentError for parts that fit no tree and impossible numbers.")
      .def_property_readonly("name", &Articulation::name)
      .def_property_readonly("links", &link_names, "Names, parents before their children.")
      .def_property_readonly("joints", &Articulation::movable_joints, "Names of the movable joints.")
      .def_property_readonly("dof", &Articulation::dof, "Number of movable joints.")
      .def_property_readonly("tree", &tree,
                             "All joints as dicts of name, type ('fixed', 'revolute' or 'prismatic'), parent and child "
                             "(names of links) and mimics (a joint's name, or '').")
      .def_property_readonly("limits", &limits,
                             "dict of float64 [dof]: lower, upper (radians or metres), velocity, effort (Nm or N).")
      .def_property_readonly(
          "masses",
          [](const Articulation& self) {
            Eigen::VectorXd masses(static_cast<Eigen::Index>(self.links().size()));
            for (Eigen::Index i = 0; i < masses.size(); ++i) {
              masses[i] = self.links()[static_cast<std::size_t>(i)].inertial.mass;
            }
            return masses;
          },
          "float64 [L]: kilograms.")
      .def_property_readonly("visuals", &visuals,
                             "What the links look like: dicts of link (index), shape or mesh (path) with scale, "
                             "T_link_visual [4, 4] and color (RGBA).")
      .def_property_readonly("meshes", &mesh_files, "Paths of all mesh files of shapes and looks, sorted.")
      .def("link_index", &Articulation::link_index, py::arg("name"))
      .def("joint_index", &Articulation::joint_index, py::arg("name"))
      .def(
          "forward_kinematics",
          [](const Articulation& self, const Eigen::VectorXd& positions) {
            return pose_array(self.forward_kinematics(positions));
          },
          py::arg("positions"), "float64 [L, 4, 4]: T_base_link of every link.")
      .def(
          "jacobian",
          [](const Articulation& self, const Eigen::VectorXd& positions, const std::string& link) {
            return self.jacobian(positions, self.link_index(link));
          },
          py::arg("positions"), py::arg("link"),
          "float64 [6, dof]: linear above angular velocity of the link's origin, in the base frame, by joint "
          "velocity.");
  module.def("read_surface", &read_surface, py::arg("path"), py::kw_only(),
             py::arg("scale") = Eigen::Vector3d::Ones().eval(), py::arg("link") = "",
             "What a mesh file (STL, OBJ, DAE, ...) shows, in its own axes, scaled: dict of positions float32 [V, 3], "
             "normals float32 [V, 3], triangles uint32 [T, 3], and colors float32 [V, 4] of its materials, alpha 0 "
             "where they say nothing; textures are not read. FileError names file and link.");
  bind_kinematics(module);
}
