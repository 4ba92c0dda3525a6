// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <Eigen/Core>
#include <span>
#include <string>
#include <variant>
#include <vector>

#include "wiw/core/pose.hpp"

namespace wiw::physics {

/// Shapes are centred at their frame's origin; lengths in metres.
struct Box {
  Eigen::Vector3d size;  // edge lengths
};
struct Sphere {
  double radius;
};
struct Cylinder {  // along z; collides as a prism of 32 sides
  double radius, length;
};
struct Capsule {  // along z; `length` lies between the centres of the two half spheres
  double radius, length;
};
struct ConvexHull {
  std::vector<Eigen::Vector3d> points;
};
using Shape = std::variant<Box, Sphere, Cylinder, Capsule, ConvexHull>;

/// A shape in the frame of its body or link.
struct Part {
  Shape shape;
  Pose pose = Pose::Identity();
};

/// Throws ArgumentError, naming `owner`, unless lengths are a nanometre or more, poses rigid and hulls
/// have a volume.
void check_part(const Part& part, const std::string& owner);

/// Throws ArgumentError, naming `what`, unless the pose is finite and its rotation orthonormal.
void check_pose(const Pose& pose, const std::string& what);

/// Vertices, which are some of the points, and outward counter-clockwise triangles of a hull; empty for points that
/// span no volume.
struct HullMesh {
  std::vector<Eigen::Vector3d> vertices;
  std::vector<Eigen::Vector3i> triangles;
};
HullMesh hull_mesh(std::span<const Eigen::Vector3d> points);

/// The same for points that are known to span a volume, however little: a cylinder may be as thin as one likes.
HullMesh thin_hull_mesh(std::span<const Eigen::Vector3d> points);

struct MassProperties {
  double mass = 0;
  Eigen::Vector3d center = Eigen::Vector3d::Zero();
  Eigen::Matrix3d inertia = Eigen::Matrix3d::Zero();  // about the centre, in the axes of the frame
};

/// Of parts of one density that weigh `mass` together (overlaps count twice).
MassProperties mass_properties(std::span<const Part> parts, double mass);

/// The same, `pose` applied.
MassProperties moved(const MassProperties& properties, const Pose& pose);
/// Of two things joined rigidly.
MassProperties joined(const MassProperties& a, const MassProperties& b);

/// Frame at the centre of mass whose axes diagonalise the inertia.
struct PrincipalFrame {
  Pose pose = Pose::Identity();
  Eigen::Vector3d moments = Eigen::Vector3d::Zero();
};
PrincipalFrame principal_frame(const MassProperties& properties);

}  // namespace wiw::physics
