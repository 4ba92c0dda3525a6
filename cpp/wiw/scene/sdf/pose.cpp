// SPDX-License-Identifier: Apache-2.0
#include "wiw/scene/sdf/pose.hpp"

#include <cmath>
#include <numbers>
#include <sstream>
#include <string>
#include <vector>

#include "wiw/core/error.hpp"

namespace wiw::sdf {
namespace {

constexpr int kMostHops = 64;  // of relative_to; more is a circle

std::string place(const pugi::xml_node& element) {
  return "<" + std::string(element.name()) + "> of '" + element.parent().attribute("name").as_string("?") + "'";
}

pugi::xml_node sibling_named(const pugi::xml_node& element, const std::string& name) {
  for (const pugi::xml_node& sibling : element.parent().children()) {
    const std::string kind = sibling.name();
    if (kind != "link" && kind != "frame" && kind != "model" && kind != "include") continue;
    if (name == sibling.attribute("name").value() || name == sibling.child_value("name")) return sibling;
  }
  return {};
}

/// `relative_to` since SDF 1.7, `frame` in 1.5 and 1.6; for a <frame> element without it, what it is attached to.
std::string reference_frame(const pugi::xml_node& element) {
  const pugi::xml_node pose = element.child("pose");
  for (const char* key : {"relative_to", "frame"}) {
    if (*pose.attribute(key).value()) return pose.attribute(key).value();
  }
  return element.attribute("attached_to").value();
}

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

Eigen::Isometry3d pose_in_parent(const pugi::xml_node& element, const std::filesystem::path& file) {
  Eigen::Isometry3d pose = own_pose(element, file);
  pugi::xml_node current = element;
  for (int hop = 0; hop < kMostHops; ++hop) {
    const std::string frame = reference_frame(current);
    if (frame.empty() || frame == "world" || frame == "__model__") return pose;
    const pugi::xml_node next = sibling_named(current, frame);
    if (!next) {
      throw FileError(file.string(), "the pose of '" + std::string(current.attribute("name").value()) +
                                         "' is relative to '" + frame +
                                         "', which is no link, frame or model beside it");
    }
    pose = own_pose(next, file) * pose;
    current = next;
  }
  throw FileError(file.string(),
                  "the pose of '" + std::string(element.attribute("name").value()) + "' is relative to itself");
}

}  // namespace wiw::sdf
