// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <Eigen/Core>
#include <filesystem>
#include <optional>
#include <pugixml.hpp>
#include <string>
#include <vector>

namespace wiw::scene::sdf {

/// Colour of a <material>: <diffuse>, else <ambient>, else the plain colour that a script such as `Gazebo/Red` names.
/// Empty without a <material> or for one that names none of these; the latter adds a warning.
std::optional<Eigen::Vector4f> material_color(const pugi::xml_node& visual, const std::filesystem::path& file,
                                              std::vector<std::string>& warnings);

}  // namespace wiw::scene::sdf
