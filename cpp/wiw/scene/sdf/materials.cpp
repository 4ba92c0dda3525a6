// SPDX-License-Identifier: Apache-2.0
#include "wiw/scene/sdf/materials.hpp"

#include <array>
#include <sstream>
#include <string_view>

#include "wiw/core/error.hpp"
#include "wiw/scene/sdf/pose.hpp"

namespace wiw::scene::sdf {
namespace {

struct NamedColor {
  std::string_view name;
  float red, green, blue;
};

// The plain colours among Gazebo's built-in material scripts; its textured ones are files of the simulator.
constexpr std::array<NamedColor, 14> kScripts{{{"Gazebo/White", 1.f, 1.f, 1.f},
                                               {"Gazebo/Grey", .7f, .7f, .7f},
                                               {"Gazebo/Gray", .7f, .7f, .7f},
                                               {"Gazebo/DarkGrey", .175f, .175f, .175f},
                                               {"Gazebo/DarkGray", .175f, .175f, .175f},
                                               {"Gazebo/FlatBlack", .1f, .1f, .1f},
                                               {"Gazebo/Black", 0.f, 0.f, 0.f},
                                               {"Gazebo/Red", 1.f, 0.f, 0.f},
                                               {"Gazebo/Green", 0.f, 1.f, 0.f},
                                               {"Gazebo/Blue", 0.f, 0.f, 1.f},
                                               {"Gazebo/Yellow", 1.f, 1.f, 0.f},
                                               {"Gazebo/Purple", 1.f, 0.f, 1.f},
                                               {"Gazebo/Turquoise", 0.f, 1.f, 1.f},
                                               {"Gazebo/Orange", 1.f, .51f, .09f}}};

Eigen::Vector4f color_of(const pugi::xml_node& element, const std::filesystem::path& file) {
  std::istringstream stream(element.child_value());
  Eigen::Vector4f color = Eigen::Vector4f::Ones();
  if (!(stream >> color[0] >> color[1] >> color[2])) {
    throw FileError(file.string(), "<" + std::string(element.name()) + "> should hold 3 or 4 numbers, got '" +
                                       element.child_value() + "'");
  }
  return color.cwiseMax(0.f).cwiseMin(1.f);
}

}  // namespace

std::optional<Eigen::Vector4f> material_color(const pugi::xml_node& visual, const std::filesystem::path& file,
                                              std::vector<std::string>& warnings) {
  const pugi::xml_node material = visual.child("material");
  for (const char* name : {"diffuse", "ambient"}) {
    if (const pugi::xml_node element = material.child(name)) return color_of(element, file);
  }
  const std::string script = material.child("script").child_value("name");
  for (const NamedColor& row : kScripts) {
    if (script == row.name) return Eigen::Vector4f(row.red, row.green, row.blue, 1.f);
  }
  if (!script.empty()) warnings.push_back("material script '" + script + "' is not known and left out");
  if (material.child("pbr"))
    warnings.push_back("a <pbr> material of " + file.string() + " is not supported and left out");
  return std::nullopt;
}

}  // namespace wiw::scene::sdf
