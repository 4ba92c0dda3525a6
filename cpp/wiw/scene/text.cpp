// SPDX-License-Identifier: Apache-2.0
#include "wiw/scene/text.hpp"

#include <utility>

#include "wiw/core/utf8.hpp"

namespace wiw::scene {
namespace {

void make_utf8(std::map<std::string, std::string>& attributes) {
  std::map<std::string, std::string> texts;
  for (const auto& [key, value] : attributes) texts.emplace(to_utf8(key), to_utf8(value));
  attributes = std::move(texts);
}

}  // namespace

void make_text_utf8(Scene& scene) {
  scene.name = to_utf8(scene.name);
  for (Texture& texture : scene.textures) texture.name = to_utf8(texture.name);
  for (Material& material : scene.materials) material.name = to_utf8(material.name);
  for (Instance& instance : scene.instances) {
    instance.name = to_utf8(instance.name);
    make_utf8(instance.attributes);
  }
  for (std::string& category : scene.categories) category = to_utf8(category);
  for (std::string& warning : scene.warnings) warning = to_utf8(warning);
  make_utf8(scene.attributes);
}

}  // namespace wiw::scene
