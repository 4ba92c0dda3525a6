// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <Eigen/Core>
#include <filesystem>
#include <memory>
#include <optional>
#include <span>
#include <string>
#include <vector>

#include "wiw/physics/shape.hpp"

namespace wiw::physics {

/// What a link looks like: a primitive, or a mesh file.
struct Visual {
  std::optional<Shape> shape;
  std::filesystem::path mesh;  // empty for primitives
  Eigen::Vector3d scale = Eigen::Vector3d::Ones();
  Pose pose = Pose::Identity();
  Eigen::Vector4d color{0.7, 0.7, 0.7, 1};  // RGBA
};

struct Link {
  std::string name;
  std::vector<std::filesystem::path> meshes;  // files of its shapes and looks
  MassProperties inertial;                    // in the link's frame
  std::vector<Part> collision;                // meshes as their convex hulls
  std::vector<Visual> visual;
};

/// A mimic joint, which follows another one: `multiplier` x its position + `offset`.
struct Mimic {
  int index = 0;  // of the other, among the movable joints
  double multiplier = 1, offset = 0;
};

enum class JointType { kFixed, kRevolute, kPrismatic };

/// Joint `i` of an articulation carries its link `i + 1`.
struct Joint {
  std::string name;
  JointType type = JointType::kFixed;
  int parent = 0;                  // link
  Pose origin = Pose::Identity();  // T_parent_child at position 0
  Eigen::Vector3d axis = Eigen::Vector3d::UnitX();
  int index = -1;  // among the movable joints; -1 for fixed ones
  std::optional<Mimic> mimic;
};

/// Limits of the movable joints: radians or metres, per second, newton metres or newtons.
struct JointLimits {
  Eigen::VectorXd lower, upper, velocity, effort;
};

/// T_parent_child of a joint at position `q`.
Pose joint_transform(const Joint& joint, double q);

/// A tree of links on a fixed base: kinematics, inertias, limits and shapes, read from URDF. Immutable; may be shared
/// between worlds and threads. Link 0 is the base, parents come before their children.
class Articulation {
 public:
  /// Throws FileError for a file or mesh that is missing or damaged (the message names the link), ArgumentError for
  /// joint types other than fixed, revolute, continuous and prismatic, and for impossible numbers.
  static std::shared_ptr<const Articulation> load(const std::filesystem::path& urdf);
  /// `folder` is where relative mesh files are looked for.
  static std::shared_ptr<const Articulation> parse(const std::string& urdf, const std::filesystem::path& folder = {});

  /// Expects consistent parts; those who read a URDF file or parts check them.
  Articulation(std::string name, std::vector<Link> links, std::vector<Joint> joints, JointLimits limits);

  [[nodiscard]] const std::string& name() const { return name_; }
  [[nodiscard]] const std::vector<Link>& links() const { return links_; }
  [[nodiscard]] const std::vector<Joint>& joints() const { return joints_; }
  [[nodiscard]] const JointLimits& limits() const { return limits_; }
  [[nodiscard]] int dof() const { return static_cast<int>(limits_.lower.size()); }
  [[nodiscard]] std::vector<std::string> movable_joints() const;
  /// Throws ArgumentError listing the links there are.
  [[nodiscard]] int link_index(const std::string& name) const;
  [[nodiscard]] int joint_index(const std::string& name) const;

  /// Throws ArgumentError unless there are `dof` finite numbers.
  void check_positions(const Eigen::VectorXd& positions, const char* what) const;
  /// As check_positions, and within the limits up to 1e-6.
  void check_within_limits(const Eigen::VectorXd& positions, const char* what) const;

  /// The positions with those of mimic joints computed from the joints they mimic, within their limits.
  [[nodiscard]] Eigen::VectorXd apply_mimics(Eigen::VectorXd positions) const;

  /// T_base_link of every link.
  [[nodiscard]] std::vector<Pose> forward_kinematics(const Eigen::VectorXd& positions) const;
  /// [6, dof]: linear above angular velocity of the link's origin, in the base frame, by joint velocity.
  [[nodiscard]] Eigen::MatrixXd jacobian(const Eigen::VectorXd& positions, int link) const;

 private:
  std::string name_;
  std::vector<Link> links_;
  std::vector<Joint> joints_;
  JointLimits limits_;
};

using ArticulationPtr = std::shared_ptr<const Articulation>;

}  // namespace wiw::physics
