// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <Eigen/Geometry>
#include <filesystem>
#include <pugixml.hpp>

namespace wiw::sdf {

/// Numbers of an element's text; throws FileError naming the element unless there are `count` finite ones.
std::vector<double> numbers(const pugi::xml_node& element, std::size_t count, const std::filesystem::path& file);

/// The <pose> child's own value: x y z roll pitch yaw, rotation Rz(yaw) Ry(pitch) Rx(roll); identity without a child.
/// `degrees="true"` and `rotation_format="quat_xyzw"` are understood.
Eigen::Isometry3d own_pose(const pugi::xml_node& element, const std::filesystem::path& file);

/// Pose of a link, frame or nested model in the model (or world) that holds it, following `relative_to` through its
/// siblings. Throws FileError if the named frame is not a sibling or the names run in a circle.
Eigen::Isometry3d pose_in_parent(const pugi::xml_node& element, const std::filesystem::path& file);

}  // namespace wiw::sdf
