// SPDX-License-Identifier: Apache-2.0
#include "wiw/scene/sdf/pose.hpp"

#include <cmath>
#include <numbers>
#include <sstream>
#include <string>
#include <vector>

#include "wiw/core/error.hpp"

namespace wiw::scene::sdf {
namespace {

constexpr int kMostHops = 1000;  // from frame to frame; more is a circle

std::string place(const pugi::xml_node& element) {
  return "<" + std::string(element.name()) + "> of '" + element.parent().attribute("name").as_string("?") + "'";
}

std::string name_of(const pugi::xml_node& element) {
  return element.attribute("name") ? element.attribute("name").value() : element.child_value("name");
}

pugi::xml_node child_named(const pugi::xml_node& model, const std::string& name) {
  for (const pugi::xml_node& child : model.children()) {
    const std::string kind = child.name();
    const bool is_frame = kind == "link" || kind == "joint" || kind == "frame" || kind == "model" || kind == "include";
    if (is_frame && !name.empty() && name == name_of(child)) return child;
  }
  return {};
}

/// What the pose is relative to by name: `relative_to` since SDF 1.7, `frame` in 1.5 and 1.6; without it, what a
/// <frame> is attached to and the child link of a <joint>.
std::string reference_name(const pugi::xml_node& element) {
  const pugi::xml_node pose = element.child("pose");
  for (const char* key : {"relative_to", "frame"}) {
    if (*pose.attribute(key).value()) return pose.attribute(key).value();
  }
  const std::string kind = element.name();
  return kind == "joint" ? element.child_value("child") : element.attribute("attached_to").value();
}

/// One question for a pose. Names are those of the model around the element, `part::name` those of a model nested in
/// it (http://sdformat.org/tutorials?tut=pose_frame_semantics).
class FrameWalk {
 public:
  explicit FrameWalk(const std::filesystem::path& file) : file_(file) {}

  Eigen::Isometry3d pose_of(const pugi::xml_node& element) {
    if (++hops_ > kMostHops)
      throw UnknownFrame(file_.string(), "the pose of '" + name_of(element) + "' is relative to itself");
    const Eigen::Isometry3d pose = reference_of(element) * own_pose(element, file_);
    const std::string placed = element.attribute("placement_frame").value();
    return placed.empty() ? pose : pose * frame_in(element, placed, name_of(element)).inverse();
  }

  Eigen::Isometry3d frame_in(const pugi::xml_node& model, const std::string& frame, const std::string& asker) {
    const bool is_model = std::string(model.name()) == "model";
    if (frame == (is_model ? "__model__" : "world")) return Eigen::Isometry3d::Identity();
    const std::size_t cut = frame.find("::");
    const pugi::xml_node found = child_named(model, frame.substr(0, cut));
    if (!found) {
      throw UnknownFrame(file_.string(), "the pose of '" + asker + "' is relative to '" + frame +
                                             "', which is no link, joint, frame or model of the " + model.name() +
                                             " '" + name_of(model) + "'");
    }
    const Eigen::Isometry3d pose = pose_of(found);
    return cut == std::string::npos ? pose : pose * frame_in(found, frame.substr(cut + 2), asker);
  }

 private:
  Eigen::Isometry3d reference_of(const pugi::xml_node& element) {
    const bool in_link = std::string(element.parent().name()) == "link";
    const std::string frame = reference_name(element);
    if (!frame.empty())
      return frame_in(in_link ? element.parent().parent() : element.parent(), frame, name_of(element));
    return in_link ? pose_of(element.parent()) : Eigen::Isometry3d::Identity();
  }

  const std::filesystem::path& file_;
  int hops_ = 0;
};

}  // namespace

std::vector<double> numbers(const pugi::xml_node& element, std::size_t count, const std::filesystem::path& file) {
  std::istringstream stream(element.child_value());
  std::vector<double> values;
  for (double value = 0.; stream >> value;) values.push_back(value);
  bool usable = values.size() == count && stream.eof();
  for (const double value : values) usable = usable && std::isfinite(value);
  if (!usable) {
    throw FileError(file.string(), place(element) + " should hold " + std::to_string(count) + " numbers, got '" +
                                       element.child_value() + "'");
  }
  return values;
}

Eigen::Isometry3d own_pose(const pugi::xml_node& element, const std::filesystem::path& file) {
  Eigen::Isometry3d pose = Eigen::Isometry3d::Identity();
  const pugi::xml_node child = element.child("pose");
  if (!child || child.text().empty()) return pose;
  if (std::string(child.attribute("rotation_format").value()) == "quat_xyzw") {
    const auto v = numbers(child, 7, file);
    const Eigen::Quaterniond rotation(v[6], v[3], v[4], v[5]);
    if (rotation.norm() < 1e-9) throw FileError(file.string(), place(child) + " holds a quaternion of no length");
    pose.linear() = rotation.normalized().toRotationMatrix();
    pose.translation() = Eigen::Vector3d(v[0], v[1], v[2]);
    return pose;
  }
  const auto v = numbers(child, 6, file);
  const double unit = child.attribute("degrees").as_bool() ? std::numbers::pi / 180. : 1.;
  pose.linear() = (Eigen::AngleAxisd(v[5] * unit, Eigen::Vector3d::UnitZ()) *
                   Eigen::AngleAxisd(v[4] * unit, Eigen::Vector3d::UnitY()) *
                   Eigen::AngleAxisd(v[3] * unit, Eigen::Vector3d::UnitX()))
                      .toRotationMatrix();
  pose.translation() = Eigen::Vector3d(v[0], v[1], v[2]);
  return pose;
}

Eigen::Isometry3d pose_in_model(const pugi::xml_node& element, const std::filesystem::path& file) {
  return FrameWalk(file).pose_of(element);
}

Eigen::Isometry3d frame_in_model(const pugi::xml_node& model, const std::string& name,
                                 const std::filesystem::path& file) {
  return FrameWalk(file).frame_in(model, name, name_of(model));
}

}  // namespace wiw::scene::sdf
