// SPDX-License-Identifier: Apache-2.0
#include "json_values.hpp"

#include <algorithm>

namespace wiw::fuzz {
namespace {

constexpr std::string_view kSpace = " \t\r\n";

/// Offset behind the string that begins at `begin`.
std::size_t end_of_string(std::string_view text, std::size_t begin) {
  std::size_t at = begin + 1;
  while (at < text.size() && text[at] != '"') at += text[at] == '\\' ? 2 : 1;
  return std::min(at + 1, text.size());
}

bool is_before_colon(std::string_view text, std::size_t at) {
  const std::size_t next = text.find_first_not_of(kSpace, at);
  return next != std::string_view::npos && text[next] == ':';
}

}  // namespace

std::vector<JsonValue> find_json_values(std::string_view text) {
  std::vector<JsonValue> values;
  std::vector<std::size_t> open;
  for (std::size_t at = 0; at < text.size();) {
    const char c = text[at];
    if (c == '"') {
      const std::size_t end = end_of_string(text, at);
      values.push_back({at, end, is_before_colon(text, end)});
      at = end;
    } else if (std::string_view(",: \t\r\n").find(c) != std::string_view::npos) {
      ++at;
    } else if (c == '{' || c == '[') {
      open.push_back(at++);
    } else if (c == '}' || c == ']') {
      ++at;
      if (open.empty()) continue;
      values.push_back({open.back(), at, false});
      open.pop_back();
    } else {
      const std::size_t end = std::min(text.find_first_of("{}[],: \t\r\n\"", at), text.size());
      values.push_back({at, end, false});
      at = end;
    }
  }
  return values;
}

}  // namespace wiw::fuzz
