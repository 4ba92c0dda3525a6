// SPDX-License-Identifier: Apache-2.0
#include "wiw/scene/describe.hpp"

#include <cstdio>
#include <map>

#include "wiw/scene/measure.hpp"

namespace wiw::scene {
namespace {

std::string fixed(double value, int decimals) {
  char text[64];
  std::snprintf(text, sizeof(text), "%.*f", decimals, value);
  return text;
}

/// 145844 -> "145,844".
std::string grouped(std::size_t value) {
  const std::string digits = std::to_string(value);
  std::string text;
  for (std::size_t i = 0; i < digits.size(); ++i) {
    if (i > 0 && (digits.size() - i) % 3 == 0) text += ',';
    text += digits[i];
  }
  return text;
}

std::string counted(std::size_t count, const std::string& noun) {
  return grouped(count) + " " + noun + (count == 1 ? "" : "s");
}

std::string categories_line(const Scene& scene) {
  std::map<std::string, std::size_t> counts;
  for (const Instance& instance : scene.instances) {
    ++counts[instance.category == kNone ? "(no category)"
                                        : scene.categories[static_cast<std::size_t>(instance.category)]];
  }
  std::string line;
  for (const auto& [category, count] : counts)
    line += (line.empty() ? "" : ", ") + category + " " + std::to_string(count);
  return line;
}

}  // namespace

std::string summary(const Scene& scene) {
  std::string text = "Scene '" + scene.name + "': " + counted(scene.instances.size(), "instance") + ", " +
                     counted(scene.triangle_count(), "triangle");
  if (scene.instances.empty()) return text;
  const Eigen::Vector3f size = scene.bounds().sizes();
  return text + ", " + fixed(size.x(), 1) + " x " + fixed(size.y(), 1) + " x " + fixed(size.z(), 1) + " m (x, y up, z)";
}

std::string describe(const Scene& scene) {
  constexpr double kMegabyte = 1e6;
  std::string text = summary(scene);
  for (const auto& [key, value] : scene.attributes) text.append("\n  ").append(key).append(": ").append(value);
  text += "\n  categories: " + categories_line(scene);
  if (!scene.rooms.empty()) {
    text += "\n  rooms: ";
    for (std::size_t i = 0; i < scene.rooms.size(); ++i) text.append(i ? ", " : "").append(scene.rooms[i].name);
  }
  text += "\n  memory: " + counted(scene.meshes.size(), "mesh buffer") + " " +
          fixed(static_cast<double>(mesh_bytes(scene)) / kMegabyte, 1) + " MB, " +
          counted(scene.textures.size(), "texture") + " " +
          fixed(static_cast<double>(texture_bytes(scene)) / kMegabyte, 1) + " MB";
  for (const std::string& warning : scene.warnings) text += "\n  warning: " + warning;
  return text;
}

}  // namespace wiw::scene
