// SPDX-License-Identifier: Apache-2.0
#include "wiw/physics/urdf_text.hpp"

#include <array>
#include <charconv>
#include <cmath>
#include <pugixml.hpp>
#include <sstream>
#include <string_view>
#include <vector>

#include "wiw/core/error.hpp"
#include "wiw/core/utf8.hpp"

namespace wiw::physics {
namespace {

struct Numbers {
  std::string_view element, attribute;
  std::size_t count;
};

constexpr std::array<Numbers, 31> kNumbers{{{"origin", "xyz", 3},
                                            {"origin", "rpy", 3},
                                            {"axis", "xyz", 3},
                                            {"box", "size", 3},
                                            {"sphere", "radius", 1},
                                            {"cylinder", "radius", 1},
                                            {"cylinder", "length", 1},
                                            {"mesh", "scale", 3},
                                            {"color", "rgba", 4},
                                            {"mass", "value", 1},
                                            {"inertia", "ixx", 1},
                                            {"inertia", "ixy", 1},
                                            {"inertia", "ixz", 1},
                                            {"inertia", "iyy", 1},
                                            {"inertia", "iyz", 1},
                                            {"inertia", "izz", 1},
                                            {"limit", "lower", 1},
                                            {"limit", "upper", 1},
                                            {"limit", "effort", 1},
                                            {"limit", "velocity", 1},
                                            {"dynamics", "damping", 1},
                                            {"dynamics", "friction", 1},
                                            {"mimic", "multiplier", 1},
                                            {"mimic", "offset", 1},
                                            {"calibration", "rising", 1},
                                            {"calibration", "falling", 1},
                                            {"calibration", "reference_position", 1},
                                            {"safety_controller", "soft_lower_limit", 1},
                                            {"safety_controller", "soft_upper_limit", 1},
                                            {"safety_controller", "k_position", 1},
                                            {"safety_controller", "k_velocity", 1}}};

constexpr std::string_view kStandIn = "\xEF\x80\xA5";  // U+F025, of the private use area
constexpr int kDeepest = 100;                          // elements in elements; descriptions have some six
constexpr std::size_t kQuoted = 80;                    // characters of a value in a message

bool is_finite_number(std::string_view token) {
  if (token.starts_with('+')) token.remove_prefix(1);
  double value = 0;
  const auto [rest, error] = std::from_chars(token.data(), token.data() + token.size(), value);
  return error == std::errc() && rest == token.data() + token.size() && std::isfinite(value);
}

std::string replace_all(std::string_view text, std::string_view old, std::string_view with) {
  std::string result;
  for (std::size_t at = text.find(old); at != std::string_view::npos; at = text.find(old)) {
    result.append(text.substr(0, at)).append(with);
    text.remove_prefix(at + old.size());
  }
  return result.append(text);
}

class UrdfChecker : public pugi::xml_tree_walker {
 public:
  explicit UrdfChecker(std::string source) : source_(std::move(source)) {}

  bool for_each(pugi::xml_node& element) override {
    if (depth() > kDeepest) fail("its elements lie more than " + std::to_string(kDeepest) + " deep in each other");
    for (const Numbers& row : kNumbers) {
      pugi::xml_attribute attribute = element.attribute(std::string(row.attribute).c_str());
      if (row.element == element.name() && attribute) check_numbers(element, attribute, row.count);
    }
    for (pugi::xml_attribute attribute : element.attributes()) {
      attribute.set_value(replace_all(attribute.value(), "%", kStandIn).c_str());
    }
    return true;
  }

 private:
  [[noreturn]] void fail(const std::string& cause) const {
    throw FileError(source_, "not a robot description (URDF): " + cause);
  }

  void check_numbers(const pugi::xml_node& element, pugi::xml_attribute& attribute, std::size_t count) const {
    std::istringstream stream(attribute.value());
    std::vector<std::string> tokens;
    bool finite = true;
    for (std::string token; stream >> token; tokens.push_back(token)) finite = finite && is_finite_number(token);
    if (!finite || tokens.size() != count) {
      fail(std::string("<") + element.name() + "> of " + owner(element) + " has " + attribute.name() + "=\"" +
           std::string(attribute.value()).substr(0, kQuoted) + "\"; expected " +
           (count == 1 ? "a finite number" : std::to_string(count) + " finite numbers"));
    }
    std::string spaced;
    for (const std::string& token : tokens) spaced.append(spaced.empty() ? "" : " ").append(token);
    attribute.set_value(spaced.c_str());
  }

  /// "link 'hand'": the named child of <robot> that an element belongs to.
  static std::string owner(pugi::xml_node element) {
    while (element.parent().parent().parent()) element = element.parent();
    return std::string(element.name()) + " '" + element.attribute("name").value() + "'";
  }

  std::string source_;
};

}  // namespace

std::string check_urdf_text(const std::string& text, const std::string& source) {
  pugi::xml_document document;
  const std::string utf8 = to_utf8(text);
  const pugi::xml_parse_result result = document.load_buffer(utf8.data(), utf8.size());
  if (!result) {
    throw FileError(source, "not a robot description (URDF): " + std::string(result.description()) + " at byte " +
                                std::to_string(result.offset));
  }
  UrdfChecker checker(source);
  pugi::xml_node robot = document.child("robot");
  if (robot) checker.for_each(robot);
  for (const char* part : {"link", "joint", "material"}) {
    for (pugi::xml_node element : robot.children(part)) {
      checker.for_each(element);
      element.traverse(checker);
    }
  }
  std::ostringstream checked;
  document.save(checked, "", pugi::format_raw, pugi::encoding_utf8);
  return checked.str();
}

std::string restore_percent_signs(const std::string& text) { return replace_all(text, kStandIn, "%"); }

}  // namespace wiw::physics
