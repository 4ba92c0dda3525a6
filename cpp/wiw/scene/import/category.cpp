// SPDX-License-Identifier: Apache-2.0
#include "wiw/scene/import/category.hpp"

#include <algorithm>
#include <array>
#include <cctype>

namespace wiw::scene {
namespace {

constexpr std::array<std::string_view, 31> kEmptyWords{
    "mesh",     "meshes",    "node",  "nodes",    "object",   "objects",  "defaultobject", "default",
    "geometry", "geom",      "group", "groups",   "root",     "scene",    "visual",        "collision",
    "model",    "primitive", "mat",   "material", "untitled", "polygon",  "shape",         "obj",
    "instance", "lod",       "low",   "high",     "link",     "textured", "unnamed"};

bool is_letter(char c) { return std::isalpha(static_cast<unsigned char>(c)) != 0; }
bool is_upper(char c) { return std::isupper(static_cast<unsigned char>(c)) != 0; }

std::string_view without_publisher(std::string_view name) {
  constexpr std::string_view kPublisher = "aws_robomaker_";
  if (!name.starts_with(kPublisher)) return name;
  const std::size_t kind_end = name.find('_', kPublisher.size());
  return kind_end == std::string_view::npos ? name : name.substr(kind_end + 1);
}

/// A capital begins a word after a small letter, or before one ("TVCabinet": at C).
bool word_begins(std::string_view name, std::size_t i) {
  if (i == 0 || !is_letter(name[i - 1])) return true;
  if (!is_upper(name[i])) return false;
  return !is_upper(name[i - 1]) || (i + 1 < name.size() && is_letter(name[i + 1]) && !is_upper(name[i + 1]));
}

std::vector<std::string> words_of(std::string_view name) {
  std::vector<std::string> words;
  for (std::size_t i = 0; i < name.size(); ++i) {
    if (!is_letter(name[i])) continue;
    if (word_begins(name, i)) words.emplace_back();
    words.back() += static_cast<char>(std::tolower(static_cast<unsigned char>(name[i])));
  }
  return words;
}

}  // namespace

std::string category_from_name(std::string_view name) {
  std::vector<std::string> words = words_of(without_publisher(name));
  std::erase_if(words, [](const std::string& word) {
    return word.size() == 1 || std::ranges::find(kEmptyWords, word) != kEmptyWords.end();
  });
  if (words.size() > 1 && (words[0] == "room" || words[0] == "house")) words.erase(words.begin());
  std::string category;
  for (const std::string& word : words) category += (category.empty() ? "" : " ") + word;
  return category;
}

std::int32_t category_index(Scene& scene, const std::string& category) {
  if (category.empty()) return kNone;
  const auto found = std::ranges::find(scene.categories, category);
  if (found != scene.categories.end()) return static_cast<std::int32_t>(found - scene.categories.begin());
  scene.categories.push_back(category);
  return static_cast<std::int32_t>(scene.categories.size() - 1);
}

}  // namespace wiw::scene
