// SPDX-License-Identifier: Apache-2.0
#include "wiw/scene/import/collada_check.hpp"

#include <algorithm>
#include <array>
#include <charconv>
#include <cstdint>
#include <map>
#include <pugixml.hpp>
#include <string>
#include <string_view>

#include "wiw/core/error.hpp"

namespace wiw::scene {
namespace {

struct Requirement {
  std::string_view element;
  const char* attribute;
};

constexpr std::array<Requirement, 22> kRequired{{{"source", "id"},
                                                 {"float_array", "id"},
                                                 {"float_array", "count"},
                                                 {"accessor", "source"},
                                                 {"accessor", "count"},
                                                 {"param", "type"},
                                                 {"vertices", "id"},
                                                 {"input", "semantic"},
                                                 {"input", "source"},
                                                 {"triangles", "count"},
                                                 {"polylist", "count"},
                                                 {"polygons", "count"},
                                                 {"lines", "count"},
                                                 {"geometry", "id"},
                                                 {"instance_geometry", "url"},
                                                 {"instance_controller", "url"},
                                                 {"instance_effect", "url"},
                                                 {"instance_material", "symbol"},
                                                 {"instance_material", "target"},
                                                 {"effect", "id"},
                                                 {"visual_scene", "id"},
                                                 {"instance_visual_scene", "url"}}};

constexpr int kDeepest = 1000;  // elements in elements

class Walker : public pugi::xml_tree_walker {
 public:
  explicit Walker(std::string path) : path_(std::move(path)) {}

  bool for_each(pugi::xml_node& node) override {
    if (depth() > kDeepest) throw FileError(path_, "its elements lie too deep in each other (damaged file)");
    for (const Requirement& requirement : kRequired) {
      if (requirement.element != node.name() || is_other_use(node)) continue;
      if (!node.attribute(requirement.attribute)) {
        throw FileError(path_, "a <" + std::string(node.name()) + "> element has no attribute '" +
                                   requirement.attribute + "' (damaged file)");
      }
      if (lies_in_its_like(node)) {
        throw FileError(path_, "a <" + std::string(node.name()) + "> element lies in another one (damaged file)");
      }
    }
    const std::string_view name = node.name();
    const bool is_list = name == "p" || name == "h" || name == "vcount" || name == "v";
    if (is_list &&
        std::string_view(node.child_value()).find_first_not_of("0123456789- \t\r\n") != std::string_view::npos) {
      throw FileError(path_, "a <" + std::string(name) + "> list holds more than whole numbers (damaged file)");
    }
    return true;
  }

 private:
  /// No element that assimp goes by does so in the schema.
  static bool lies_in_its_like(const pugi::xml_node& node) {
    pugi::xml_node above = node.parent();
    while (above && std::string_view(above.name()) != node.name()) above = above.parent();
    return !above.empty();
  }

  /// The schema reuses a few names: <source> and <param> inside samplers and surfaces hold plain text.
  static bool is_other_use(const pugi::xml_node& node) {
    const std::string_view name = node.name();
    const std::string_view parent = node.parent().name();
    return (name == "source" && parent.starts_with("sampler")) || (name == "param" && parent != "accessor");
  }

  std::string path_;
};

/// Every accessor must find its values inside the array it names.
void check_accessors(const pugi::xml_document& document, const std::string& path) {
  std::map<std::string, std::uint64_t> counts;
  for (const pugi::xpath_node& array : document.select_nodes("//float_array | //Name_array | //IDREF_array")) {
    const std::uint64_t count = array.node().attribute("count").as_ullong();
    const auto [first, is_new] = counts.try_emplace(array.node().attribute("id").value(), count);
    if (!is_new) first->second = std::min(first->second, count);  // assimp may have read either
  }
  for (const pugi::xpath_node& found : document.select_nodes("//accessor")) {
    const pugi::xml_node accessor = found.node();
    const std::string name = accessor.attribute("source").value();
    const auto array = counts.find(name.substr(name.starts_with('#') ? 1 : 0));
    const std::uint64_t count = accessor.attribute("count").as_ullong();
    const std::uint64_t stride = accessor.attribute("stride").as_ullong(1);
    const std::uint64_t offset = accessor.attribute("offset").as_ullong(0);
    const std::uint64_t available = array == counts.end() ? 0 : array->second;
    if (count == 0) continue;
    if (count > available || stride > available || offset > available || count * stride + offset > available) {
      throw FileError(path, "an <accessor> reads " + std::to_string(count) + " x " + std::to_string(stride) +
                                " values of '" + name + "', which has " + std::to_string(available) +
                                " (damaged file)");
    }
  }
}

/// Characters of the children of a name, of which a list needs one for each number.
std::uint64_t length_of(const pugi::xml_node& element, const char* child) {
  std::uint64_t length = 0;
  for (const pugi::xml_node& list : element.children(child)) length += std::string_view(list.child_value()).size();
  return length;
}

std::uint64_t sum_of(std::string_view numbers) {
  std::uint64_t sum = 0;
  while (!numbers.empty()) {
    std::uint32_t number = 0;
    const auto [rest, error] = std::from_chars(numbers.data(), numbers.data() + numbers.size(), number);
    sum += error == std::errc::result_out_of_range ? UINT32_MAX : number;
    numbers.remove_prefix(std::max<std::size_t>(1, static_cast<std::size_t>(rest - numbers.data())));
  }
  return sum;
}

/// assimp takes memory for as many numbers as an element announces.
class Announcements {
 public:
  Announcements(const pugi::xml_document& document, std::string path) : document_(document), path_(std::move(path)) {}

  void check() const {
    for_each("//float_array | //Name_array | //IDREF_array", [&](const pugi::xml_node& array) {
      compare(array, count_of(array), std::string_view(array.child_value()).size());
    });
    for_each("//triangles", [&](const pugi::xml_node& part) { check_points(part, 3 * count_of(part)); });
    for_each("//lines", [&](const pugi::xml_node& part) { check_points(part, 2 * count_of(part)); });
    for_each("//polylist", [&](const pugi::xml_node& part) {
      compare(part, count_of(part), length_of(part, "vcount"));
      check_points(part, sum_of(part.child_value("vcount")));
    });
    for_each("//vertex_weights", [&](const pugi::xml_node& part) {
      compare(part, count_of(part), length_of(part, "vcount"));
      compare(part, sum_of(part.child_value("vcount")), length_of(part, "v"));
    });
  }

 private:
  static std::uint64_t count_of(const pugi::xml_node& element) { return element.attribute("count").as_uint(); }

  template <class Use>
  void for_each(const char* path, const Use& use) const {
    for (const pugi::xpath_node& found : document_.select_nodes(path)) use(found.node());
  }

  /// Each point has an index for each offset of an input.
  void check_points(const pugi::xml_node& part, std::uint64_t points) const {
    std::uint64_t indices = 1;
    for (const pugi::xml_node& input : part.children("input")) {
      indices = std::max(indices, std::uint64_t{input.attribute("offset").as_uint()} + 1);
    }
    compare(part, points, length_of(part, "p") / indices);
  }

  void compare(const pugi::xml_node& element, std::uint64_t announced, std::uint64_t most) const {
    if (announced <= most) return;
    throw FileError(path_, "a <" + std::string(element.name()) + "> element announces " + std::to_string(announced) +
                               " values or points, but has at most " + std::to_string(most) + " (damaged file)");
  }

  const pugi::xml_document& document_;
  std::string path_;
};

/// Nodes may show other nodes; assimp copies these, and calls itself, for as long as there are any.
class Instances {
 public:
  Instances(const pugi::xml_document& document, std::string path) : path_(std::move(path)) {
    for (const pugi::xpath_node& found : document.select_nodes("//node")) {
      for (const char* name : {"name", "sid", "id"}) {  // the last one wins
        if (const auto key = found.node().attribute(name)) nodes_[key.value()] = found.node();
      }
    }
  }

  void check(const pugi::xml_document& document) {
    for (const pugi::xpath_node& found : document.select_nodes("//visual_scene")) size(found.node(), 0);
  }

 private:
  /// How many nodes come of an element.
  std::uint64_t size(const pugi::xml_node& element, int depth) {
    if (depth > kDeepest) throw FileError(path_, "its nodes lie too deep in each other (damaged file)");
    const auto [known, is_new] = sizes_.try_emplace(element, 0);
    if (!is_new && known->second == 0) throw FileError(path_, "a <node> shows itself (damaged file)");
    if (!is_new) return known->second;
    std::uint64_t total = 1;
    for (const pugi::xml_node& child : element.children("node")) total += size(child, depth + 1);
    for (const pugi::xml_node& instance : element.children("instance_node")) {
      const std::string url = instance.attribute("url").value();
      const auto target = nodes_.find(url.substr(url.starts_with('#') ? 1 : 0));
      if (target != nodes_.end()) total += size(target->second, depth + 1);
    }
    if (total > kMostNodes) throw FileError(path_, "its nodes show more than a million nodes (damaged file)");
    return sizes_[element] = total;
  }

  static constexpr std::uint64_t kMostNodes = 1'000'000;
  std::string path_;
  std::map<std::string, pugi::xml_node> nodes_;
  std::map<pugi::xml_node, std::uint64_t> sizes_;  // 0: being looked at
};

}  // namespace

void check_collada(const std::filesystem::path& path) {
  pugi::xml_document document;
  const pugi::xml_parse_result result = document.load_file(path.c_str());
  if (!result) {
    throw FileError(path.string(), "is not well-formed XML: " + std::string(result.description()) + " at byte " +
                                       std::to_string(result.offset));
  }
  Walker walker(path.string());
  document.traverse(walker);
  Announcements(document, path.string()).check();
  check_accessors(document, path.string());
  Instances(document, path.string()).check(document);
}

}  // namespace wiw::scene
