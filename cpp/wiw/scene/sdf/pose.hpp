// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <Eigen/Geometry>
#include <filesystem>
#include <pugixml.hpp>
#include <string>
#include <vector>

#include "wiw/core/error.hpp"

namespace wiw::scene::sdf {

/// Numbers of an element's text; throws FileError naming the element unless there are `count` finite ones.
std::vector<double> numbers(const pugi::xml_node& element, std::size_t count, const std::filesystem::path& file);

/// The <pose> child's own value: x y z roll pitch yaw, rotation Rz(yaw) Ry(pitch) Rx(roll); identity without a child.
/// `degrees="true"` and `rotation_format="quat_xyzw"` are understood.
Eigen::Isometry3d own_pose(const pugi::xml_node& element, const std::filesystem::path& file);

/// A pose is relative to a name that is not there, or to itself.
class UnknownFrame : public FileError {
 public:
  using FileError::FileError;
};

/// Pose of a link, joint, frame, visual or nested model in the model (or world) around it, following `relative_to`,
/// `attached_to` and `placement_frame`. Throws UnknownFrame for a name that leads nowhere or in a circle.
Eigen::Isometry3d pose_in_model(const pugi::xml_node& element, const std::filesystem::path& file);

/// Pose in `model` of the link, joint, frame or nested model of that name. Throws UnknownFrame.
Eigen::Isometry3d frame_in_model(const pugi::xml_node& model, const std::string& name,
                                 const std::filesystem::path& file);

}  // namespace wiw::scene::sdf
