// SPDX-License-Identifier: Apache-2.0
#include "physics_parts.hpp"

#include <pybind11/stl.h>
#include <pybind11/stl/filesystem.h>

#include <cmath>
#include <string>
#include <vector>

#include "wiw/core/error.hpp"
#include "wiw/physics/articulation_check.hpp"

namespace py = pybind11;
using namespace wiw;
using namespace wiw::physics;

namespace {

using Numbers = std::vector<double>;

const std::string kParts = "parts of an articulation";

template <class Matrix>
Numbers numbers_of(const Matrix& matrix) {
  return Numbers(matrix.data(), matrix.data() + matrix.size());
}

template <class Matrix>
Matrix matrix_of(const py::handle& value) {
  const auto numbers = value.cast<Numbers>();
  Matrix matrix;
  if constexpr (Matrix::SizeAtCompileTime == Eigen::Dynamic) matrix.resize(static_cast<Eigen::Index>(numbers.size()));
  if (numbers.size() != static_cast<std::size_t>(matrix.size())) {
    throw ArgumentError(kParts + ": expected " + std::to_string(matrix.size()) + " numbers, got " +
                        std::to_string(numbers.size()));
  }
  std::copy(numbers.begin(), numbers.end(), matrix.data());
  return matrix;
}

Pose pose_of(const py::handle& value) {
  Pose pose;
  pose.matrix() = matrix_of<Eigen::Matrix4d>(value);
  check_pose(pose, "a pose in the parts of an articulation");
  return pose;
}

struct ShapeToParts {
  py::dict operator()(const Box& box) const { return py::dict(py::arg("box") = numbers_of(box.size)); }
  py::dict operator()(const Sphere& sphere) const { return py::dict(py::arg("sphere") = sphere.radius); }
  py::dict operator()(const Cylinder& cylinder) const {
    return py::dict(py::arg("cylinder") = Numbers{cylinder.radius, cylinder.length});
  }
  py::dict operator()(const Capsule& capsule) const {
    return py::dict(py::arg("capsule") = Numbers{capsule.radius, capsule.length});
  }
  py::dict operator()(const ConvexHull& hull) const {
    std::vector<Numbers> points;
    for (const Eigen::Vector3d& point : hull.points) points.push_back(numbers_of(point));
    return py::dict(py::arg("hull") = points);
  }
};

Shape shape_of(const py::dict& parts) {
  if (parts.contains("box")) return Box{matrix_of<Eigen::Vector3d>(parts["box"])};
  if (parts.contains("sphere")) return Sphere{parts["sphere"].cast<double>()};
  if (parts.contains("hull")) {
    ConvexHull hull;
    for (const py::handle point : parts["hull"]) hull.points.push_back(matrix_of<Eigen::Vector3d>(point));
    return hull;
  }
  const bool is_cylinder = parts.contains("cylinder");
  const auto lengths = matrix_of<Eigen::Vector2d>(parts[is_cylinder ? "cylinder" : "capsule"]);
  if (is_cylinder) return Cylinder{lengths[0], lengths[1]};
  return Capsule{lengths[0], lengths[1]};
}

py::dict visual_to_parts(const Visual& visual) {
  py::dict parts;
  parts["shape"] = visual.shape ? py::object(std::visit(ShapeToParts{}, *visual.shape)) : py::none();
  parts["mesh"] = visual.mesh.empty() ? py::object(py::none()) : py::str(py::cast(visual.mesh));
  parts["scale"] = numbers_of(visual.scale);
  parts["pose"] = numbers_of(visual.pose.matrix());
  parts["color"] = numbers_of(visual.color);
  return parts;
}

Visual visual_of(const py::dict& parts) {
  Visual visual;
  if (!parts["shape"].is_none()) visual.shape = shape_of(parts["shape"]);
  if (!parts["mesh"].is_none()) visual.mesh = parts["mesh"].cast<std::filesystem::path>();
  visual.scale = matrix_of<Eigen::Vector3d>(parts["scale"]);
  visual.pose = pose_of(parts["pose"]);
  visual.color = matrix_of<Eigen::Vector4d>(parts["color"]);
  return visual;
}

py::dict link_to_parts(const Link& link) {
  py::dict parts;
  parts["name"] = link.name;
  py::list meshes, collision, visual;
  for (const std::filesystem::path& mesh : link.meshes) meshes.append(py::str(py::cast(mesh)));
  for (const Part& part : link.collision) {
    py::dict each = std::visit(ShapeToParts{}, part.shape);
    each["pose"] = numbers_of(part.pose.matrix());
    collision.append(each);
  }
  for (const Visual& each : link.visual) visual.append(visual_to_parts(each));
  parts["meshes"] = meshes;
  parts["mass"] = link.inertial.mass;
  parts["center"] = numbers_of(link.inertial.center);
  parts["inertia"] = numbers_of(link.inertial.inertia);
  parts["collision"] = collision;
  parts["visual"] = visual;
  return parts;
}

Link link_of(const py::dict& parts) {
  Link link{.name = parts["name"].cast<std::string>()};
  for (const py::handle mesh : parts["meshes"]) link.meshes.push_back(mesh.cast<std::filesystem::path>());
  link.inertial.mass = parts["mass"].cast<double>();
  link.inertial.center = matrix_of<Eigen::Vector3d>(parts["center"]);
  link.inertial.inertia = matrix_of<Eigen::Matrix3d>(parts["inertia"]);
  check_inertial(link.inertial, kParts + ": link '" + link.name + "'");
  for (const py::handle each : parts["collision"]) {
    link.collision.push_back({shape_of(each.cast<py::dict>()), pose_of(each["pose"])});
    check_part(link.collision.back(), kParts + ": link '" + link.name + "'");
  }
  for (const py::handle each : parts["visual"]) link.visual.push_back(visual_of(each.cast<py::dict>()));
  return link;
}

py::dict joint_to_parts(const Joint& joint) {
  py::dict parts;
  parts["name"] = joint.name;
  parts["type"] = static_cast<int>(joint.type);
  parts["parent"] = joint.parent;
  parts["origin"] = numbers_of(joint.origin.matrix());
  parts["axis"] = numbers_of(joint.axis);
  parts["index"] = joint.index;
  parts["mimic"] = py::none();
  if (joint.mimic) {
    py::list mimic;
    mimic.append(joint.mimic->index);
    mimic.append(joint.mimic->multiplier);
    mimic.append(joint.mimic->offset);
    parts["mimic"] = mimic;
  }
  return parts;
}

Joint joint_of(const py::dict& parts) {
  Joint joint{.name = parts["name"].cast<std::string>()};
  joint.type = static_cast<JointType>(parts["type"].cast<int>());
  joint.parent = parts["parent"].cast<int>();
  joint.origin = pose_of(parts["origin"]);
  joint.axis = matrix_of<Eigen::Vector3d>(parts["axis"]);
  joint.index = parts["index"].cast<int>();
  if (parts["mimic"].is_none()) return joint;
  const py::sequence mimic = parts["mimic"];
  joint.mimic = Mimic{mimic[0].cast<int>(), mimic[1].cast<double>(), mimic[2].cast<double>()};
  return joint;
}

/// Joint i carries link i + 1 and hangs on one before it; movable joints are numbered in their order.
void check_tree(const std::vector<Link>& links, const std::vector<Joint>& joints, const JointLimits& limits) {
  const auto dof = static_cast<int>(limits.lower.size());
  bool fits = links.size() == joints.size() + 1 && limits.upper.size() == dof && limits.velocity.size() == dof &&
              limits.effort.size() == dof;
  int next = 0;
  for (std::size_t i = 0; i < joints.size(); ++i) {
    const Joint& joint = joints[i];
    const bool is_fixed = joint.type == JointType::kFixed;
    fits = fits && joint.parent >= 0 && joint.parent <= static_cast<int>(i);
    fits = fits && (is_fixed ? joint.index == -1 : joint.index == next++);
    fits = fits && joint.type >= JointType::kFixed && joint.type <= JointType::kPrismatic;
  }
  if (!fits || next != dof) throw ArgumentError(kParts + ": links, joints and limits make no tree");
}

/// Of a tree: what the URDF reader asks of movable joints.
void check_joints(const std::vector<Joint>& joints, const JointLimits& limits) {
  std::vector<const Joint*> movable;
  for (const Joint& joint : joints) {
    if (joint.index >= 0) movable.push_back(&joint);
  }
  for (const Joint& joint : joints) {
    const std::string which = "joint '" + joint.name + "'";
    if (joint.mimic) {
      const auto [leader, multiplier, offset] = *joint.mimic;
      const bool leads = leader >= 0 && static_cast<std::size_t>(leader) < movable.size() &&
                         !movable[static_cast<std::size_t>(leader)]->mimic;
      if (joint.index < 0 || !leads || !std::isfinite(multiplier) || !std::isfinite(offset)) {
        throw ArgumentError(kParts + ": " + which + " mimics joint " + std::to_string(leader) + " of " +
                            std::to_string(movable.size()) +
                            "; expected two movable joints, of which the other mimics none, a finite multiplier and "
                            "offset");
      }
    }
    if (joint.index < 0) continue;
    if (!joint.axis.allFinite() || std::abs(joint.axis.norm() - 1) > 1e-6) {
      throw ArgumentError(kParts + ": expected the axis of " + which + " to have length 1, got " +
                          std::to_string(joint.axis.norm()));
    }
    check_range({limits.lower[joint.index], limits.upper[joint.index], limits.velocity[joint.index],
                 limits.effort[joint.index]},
                kParts + ": the limits of " + which);
  }
}

}  // namespace

namespace wiw::bindings {

py::dict articulation_to_parts(const Articulation& articulation) {
  py::dict parts;
  py::list links, joints;
  for (const Link& link : articulation.links()) links.append(link_to_parts(link));
  for (const Joint& joint : articulation.joints()) joints.append(joint_to_parts(joint));
  const JointLimits& limits = articulation.limits();
  parts["name"] = articulation.name();
  parts["links"] = links;
  parts["joints"] = joints;
  parts["limits"] = std::vector<Numbers>{numbers_of(limits.lower), numbers_of(limits.upper),
                                         numbers_of(limits.velocity), numbers_of(limits.effort)};
  return parts;
}

namespace {

ArticulationPtr read_parts(const py::dict& parts) {
  std::vector<Link> links;
  std::vector<Joint> joints;
  for (const py::handle link : parts["links"]) links.push_back(link_of(link.cast<py::dict>()));
  for (const py::handle joint : parts["joints"]) joints.push_back(joint_of(joint.cast<py::dict>()));
  const py::sequence rows = parts["limits"];
  JointLimits limits{matrix_of<Eigen::VectorXd>(rows[0]), matrix_of<Eigen::VectorXd>(rows[1]),
                     matrix_of<Eigen::VectorXd>(rows[2]), matrix_of<Eigen::VectorXd>(rows[3])};
  check_tree(links, joints, limits);
  check_joints(joints, limits);
  return std::make_shared<Articulation>(parts["name"].cast<std::string>(), std::move(links), std::move(joints),
                                        std::move(limits));
}

}  // namespace

ArticulationPtr articulation_from_parts(const py::dict& parts) {
  const std::string expected = kParts + ": expected what `to_parts` gives; ";
  try {
    return read_parts(parts);
  } catch (const py::error_already_set& error) {  // a key or an element that is missing
    if (!error.matches(PyExc_LookupError) && !error.matches(PyExc_TypeError)) throw;
    throw ArgumentError(expected + py::str(error.type().attr("__name__")).cast<std::string>() + ": " +
                        py::str(error.value()).cast<std::string>());
  } catch (const py::cast_error&) {  // a value of another kind
    throw ArgumentError(expected + "a value is of another kind");
  }
}

}  // namespace wiw::bindings
