// SPDX-License-Identifier: Apache-2.0
#include "wiw/action/text.hpp"

#include <cstdio>
#include <initializer_list>
#include <utility>

#include "wiw/core/error.hpp"

namespace wiw::action {

namespace {

using Replacements = std::initializer_list<std::pair<const char*, std::string>>;

std::string number(double value, const char* format) {
  char text[64];
  std::snprintf(text, sizeof(text), format, value);
  return text;
}

std::string fill(const std::string& words, Replacements replacements) {
  std::string filled;
  for (std::size_t i = 0; i < words.size();) {
    bool replaced = false;
    for (const auto& [name, value] : replacements) {
      const std::string key = std::string("{") + name + "}";
      if (words.compare(i, key.size(), key) == 0) {
        filled += value;
        i += key.size();
        replaced = true;
        break;
      }
    }
    if (!replaced) filled += words[i++];
  }
  return filled;
}

void check_prompt(const std::string& prompt) {
  if (prompt.find("{actions}") == std::string::npos) {
    throw ArgumentError("text template: expected '{actions}' in the prompt, got '" + prompt + "'");
  }
}

std::string phrase_of(Action action, int count, const TextTemplate& words, const ActionSpace& space) {
  return fill(words.phrases[static_cast<std::size_t>(action)],
              {{"metres", number(count * space.forward_m, "%g")},
               {"degrees", number(count * degrees(space.turn_rad), "%g")},
               {"count", std::to_string(count)}});
}

}  // namespace

std::string to_text(std::span<const Action> actions, const TextTemplate& words, const ActionSpace& space) {
  space.check();
  check_prompt(words.prompt);
  std::string joined;
  for (std::size_t i = 0; i < actions.size();) {
    std::size_t end = i + 1;
    while (words.merge_runs && end < actions.size() && actions[end] == actions[i]) ++end;
    if (i > 0) joined += words.separator;
    joined += phrase_of(actions[i], static_cast<int>(end - i), words, space);
    i = end;
  }
  return fill(words.prompt, {{"actions", joined}});
}

std::string to_text(std::span<const GripperPose> poses, const GripperTextTemplate& words) {
  check_prompt(words.prompt);
  std::string joined;
  for (std::size_t i = 0; i < poses.size(); ++i) {
    const GripperPose& pose = poses[i];
    if (i > 0) joined += words.separator;
    joined += fill(words.phrase, {{"x", number(pose.position.x(), "%.2f")},
                                  {"y", number(pose.position.y(), "%.2f")},
                                  {"z", number(pose.position.z(), "%.2f")},
                                  {"roll", number(degrees(pose.rpy.x()), "%.0f")},
                                  {"pitch", number(degrees(pose.rpy.y()), "%.0f")},
                                  {"yaw", number(degrees(pose.rpy.z()), "%.0f")},
                                  {"gripper", pose.gripper >= 0.5 ? "open" : "closed"}});
  }
  return fill(words.prompt, {{"actions", joined}});
}

}  // namespace wiw::action
