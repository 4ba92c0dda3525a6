// SPDX-License-Identifier: Apache-2.0
#include <console_bridge/console.h>
#include <urdf_parser/urdf_parser.h>

#include <algorithm>
#include <cmath>
#include <limits>
#include <mutex>
#include <unordered_set>

#include "wiw/core/error.hpp"
#include "wiw/physics/articulation.hpp"
#include "wiw/physics/articulation_check.hpp"
#include "wiw/physics/mesh_file.hpp"
#include "wiw/physics/urdf_text.hpp"
#include "wiw/scene/import/file.hpp"

namespace wiw::physics {

namespace fs = std::filesystem;

namespace {

/// urdfdom tells what is wrong by logging it; the first error becomes the exception's message.
class ErrorLog final : public console_bridge::OutputHandler {
 public:
  ErrorLog() { console_bridge::useOutputHandler(this); }
  ~ErrorLog() override { console_bridge::restorePreviousOutputHandler(); }
  ErrorLog(const ErrorLog&) = delete;
  ErrorLog& operator=(const ErrorLog&) = delete;
  void log(const std::string& text, console_bridge::LogLevel level, const char*, int) override {
    if (level == console_bridge::CONSOLE_BRIDGE_LOG_ERROR && first_.empty()) first_ = text;
  }
  [[nodiscard]] const std::string& first() const { return first_; }

 private:
  std::string first_;
};

urdf::ModelInterfaceSharedPtr parse_xml(const std::string& unchecked, const std::string& source) {
  const std::string text = check_urdf_text(unchecked, source);
  static std::mutex one_at_a_time;  // the handler is the process's
  const std::scoped_lock lock(one_at_a_time);
  const ErrorLog errors;
  urdf::ModelInterfaceSharedPtr model;
  std::string cause;
  try {
    model = urdf::parseURDF(text);
    cause = errors.first();
  } catch (const std::exception& error) {
    cause = error.what();
  }
  if (!model || !cause.empty()) {
    throw FileError(
        source, "not a robot description (URDF): " + (cause.empty() ? "no robot in it" : restore_percent_signs(cause)));
  }
  return model;
}

Eigen::Vector3d to_eigen(const urdf::Vector3& v) { return {v.x, v.y, v.z}; }

Pose to_pose(const urdf::Pose& from, const std::string& what) {
  Pose pose = Pose::Identity();
  const urdf::Rotation& r = from.rotation;
  pose.linear() = Eigen::Quaterniond(r.w, r.x, r.y, r.z).normalized().toRotationMatrix();
  pose.translation() = to_eigen(from.position);
  check_pose(pose, what);
  return pose;
}

constexpr int kDeepest = 1000;                // links one below another; arms have some ten
constexpr std::size_t kMaxBytes = 64u << 20;  // of a description

class UrdfReader {
 public:
  UrdfReader(const urdf::ModelInterface& model, std::string source, fs::path folder)
      : model_(model), source_(std::move(source)), folder_(std::move(folder)) {}

  ArticulationPtr read() {
    add(*model_.getRoot());
    for (Joint& joint : joints_) couple(joint);
    JointLimits limits;
    const auto vector = [&](double JointRange::* field) {
      Eigen::VectorXd values(static_cast<Eigen::Index>(ranges_.size()));
      for (std::size_t i = 0; i < ranges_.size(); ++i) values[static_cast<Eigen::Index>(i)] = ranges_[i].*field;
      return values;
    };
    limits = {vector(&JointRange::lower), vector(&JointRange::upper), vector(&JointRange::velocity),
              vector(&JointRange::effort)};
    for (Link& link : links_) link.name = restore_percent_signs(link.name);
    for (Joint& joint : joints_) joint.name = restore_percent_signs(joint.name);
    return std::make_shared<Articulation>(restore_percent_signs(model_.getName()), std::move(links_),
                                          std::move(joints_), std::move(limits));
  }

 private:
  /// A link and all below it. urdfdom lets a link have two parents, and be above itself.
  void add(const urdf::Link& from, int depth = 0) {
    if (!met_.insert(from.name).second) {
      throw ArgumentError(source_ + ": link '" + from.name + "' has two parents, or is above itself; expected a tree");
    }
    if (depth > kDeepest) {
      throw ArgumentError(source_ + ": expected at most " + std::to_string(kDeepest) + " links one below another");
    }
    const int index = static_cast<int>(links_.size());
    links_.push_back(to_link(from));
    for (const urdf::JointSharedPtr& joint : from.child_joints) {
      add_joint(*joint, index);
      add(*model_.getLink(joint->child_link_name), depth + 1);
    }
  }

  void add_joint(const urdf::Joint& from, int parent) {
    Joint joint{.name = from.name, .parent = parent};
    joint.origin = to_pose(from.parent_to_joint_origin_transform, "origin of joint '" + from.name + "'");
    if (from.type != urdf::Joint::FIXED) {
      joint.type = type_of(from);
      joint.index = static_cast<int>(ranges_.size());
      joint.axis = to_eigen(from.axis);
      if (!joint.axis.allFinite() || joint.axis.norm() < 1e-9) {
        throw ArgumentError(source_ + ": the axis of joint '" + from.name + "' has no direction");
      }
      joint.axis.normalize();
      ranges_.push_back(range_of(from));
    }
    joints_.push_back(std::move(joint));
  }

  /// Once all joints are known: what is mimicked may come later in the tree.
  void couple(Joint& joint) const {
    const auto from = model_.getJoint(joint.name)->mimic;
    if (!from || joint.index < 0) return;
    const auto other = std::ranges::find(joints_, from->joint_name, &Joint::name);
    const bool leads = other != joints_.end() && other->index >= 0 && !model_.getJoint(other->name)->mimic;
    if (!leads || !std::isfinite(from->multiplier) || !std::isfinite(from->offset)) {
      throw ArgumentError(source_ + ": joint '" + joint.name + "' mimics '" + from->joint_name +
                          "'; expected a movable joint that mimics none, a finite multiplier and offset");
    }
    joint.mimic = Mimic{other->index, from->multiplier, from->offset};
  }

  [[nodiscard]] JointType type_of(const urdf::Joint& joint) const {
    if (joint.type == urdf::Joint::REVOLUTE || joint.type == urdf::Joint::CONTINUOUS) return JointType::kRevolute;
    if (joint.type == urdf::Joint::PRISMATIC) return JointType::kPrismatic;
    throw ArgumentError(source_ + ": joint '" + joint.name +
                        "' is of a type that is not supported; expected fixed, revolute, continuous or prismatic");
  }

  [[nodiscard]] JointRange range_of(const urdf::Joint& joint) const {
    const double inf = std::numeric_limits<double>::infinity();
    JointRange range{-inf, inf, inf, inf};
    if (joint.limits) {
      if (joint.type != urdf::Joint::CONTINUOUS) range.lower = joint.limits->lower, range.upper = joint.limits->upper;
      range.velocity = joint.limits->velocity;
      range.effort = joint.limits->effort;
    }
    check_range(range, source_ + ": the limits of joint '" + joint.name + "'");
    return range;
  }

  [[nodiscard]] Link to_link(const urdf::Link& from) const {
    Link link{.name = from.name};
    if (from.inertial) link.inertial = to_inertial(*from.inertial, from.name);
    for (const urdf::CollisionSharedPtr& each : from.collision_array) {
      if (!each || !each->geometry) continue;
      link.collision.push_back({to_shape(*each->geometry, restore_percent_signs(from.name)),
                                to_pose(each->origin, "collision of link '" + from.name + "'")});
      check_part(link.collision.back(), source_ + ": link '" + from.name + "'");
      note_mesh(*each->geometry, link);
    }
    for (const urdf::VisualSharedPtr& each : from.visual_array) {
      if (!each || !each->geometry) continue;
      link.visual.push_back(to_visual(*each, from.name));
      note_mesh(*each->geometry, link);
    }
    return link;
  }

  void note_mesh(const urdf::Geometry& from, Link& link) const {
    const auto* mesh = dynamic_cast<const urdf::Mesh*>(&from);
    if (mesh != nullptr) link.meshes.push_back(mesh_of(*mesh));
  }

  [[nodiscard]] fs::path mesh_of(const urdf::Mesh& mesh) const {
    return find_mesh(restore_percent_signs(mesh.filename), folder_);
  }

  [[nodiscard]] MassProperties to_inertial(const urdf::Inertial& from, const std::string& name) const {
    Eigen::Matrix3d inertia;
    inertia << from.ixx, from.ixy, from.ixz, from.ixy, from.iyy, from.iyz, from.ixz, from.iyz, from.izz;
    const MassProperties properties =
        moved({.mass = from.mass, .inertia = inertia}, to_pose(from.origin, "inertial of link '" + name + "'"));
    check_inertial(properties, source_ + ": link '" + name + "'");
    return properties;
  }

  [[nodiscard]] Shape to_shape(const urdf::Geometry& from, const std::string& link) const {
    if (const auto* mesh = dynamic_cast<const urdf::Mesh*>(&from)) {
      return ConvexHull{hull_of_file(mesh_of(*mesh), to_eigen(mesh->scale), link)};
    }
    return primitive(from);
  }

  [[nodiscard]] static Shape primitive(const urdf::Geometry& from) {
    if (const auto* box = dynamic_cast<const urdf::Box*>(&from)) return Box{to_eigen(box->dim)};
    if (const auto* sphere = dynamic_cast<const urdf::Sphere*>(&from)) return Sphere{sphere->radius};
    const auto& cylinder = dynamic_cast<const urdf::Cylinder&>(from);
    return Cylinder{cylinder.radius, cylinder.length};
  }

  [[nodiscard]] Visual to_visual(const urdf::Visual& from, const std::string& link) const {
    Visual visual{.pose = to_pose(from.origin, "visual of link '" + link + "'")};
    if (const auto* mesh = dynamic_cast<const urdf::Mesh*>(from.geometry.get())) {
      visual.mesh = mesh_of(*mesh);
      visual.scale = to_eigen(mesh->scale);
    } else {
      visual.shape = primitive(*from.geometry);
    }
    if (from.material) {
      const urdf::Color& color = from.material->color;
      visual.color = {color.r, color.g, color.b, color.a};
    }
    return visual;
  }

  const urdf::ModelInterface& model_;
  const std::string source_;
  const fs::path folder_;
  std::unordered_set<std::string> met_;  // links by name
  std::vector<Link> links_;
  std::vector<Joint> joints_;
  std::vector<JointRange> ranges_;
};

ArticulationPtr read_model(const std::string& text, const std::string& source, const fs::path& folder) {
  const auto model = parse_xml(text, source);
  try {
    return UrdfReader(*model, source, folder).read();
  } catch (const ArgumentError& error) {
    throw ArgumentError(restore_percent_signs(error.what()));
  }
}

}  // namespace

ArticulationPtr Articulation::load(const fs::path& urdf) {
  if (scene::size_of_file(urdf) > kMaxBytes)
    throw FileError(urdf.string(), "larger than 64 MiB, which no robot has need of");
  const auto bytes = scene::read_file(urdf);
  return read_model({bytes.begin(), bytes.end()}, urdf.string(), urdf.parent_path());
}

ArticulationPtr Articulation::parse(const std::string& urdf, const fs::path& folder) {
  return read_model(urdf, "robot description", folder);
}

}  // namespace wiw::physics
