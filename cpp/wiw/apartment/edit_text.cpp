// SPDX-License-Identifier: Apache-2.0
// Edits as text.
#include <algorithm>
#include <set>

#include "wiw/apartment/edits.hpp"
#include "wiw/core/error.hpp"

namespace wiw::apartment {

namespace {

constexpr const char* kForms = "color:NAME=COLOR, state:NAME=STATE, remove:NAME or swap:NAME,NAME";

std::string with_spaces(std::string text) {
  std::replace_if(text.begin(), text.end(), [](char c) { return c == '_' || c == '+'; }, ' ');
  return text;
}

std::string without_spaces(std::string text) {
  std::replace(text.begin(), text.end(), ' ', '_');
  return text;
}

[[noreturn]] void refuse(const std::string& text, const std::string& why) {
  throw ArgumentError("edit '" + text + "': " + why);
}

/// Splits at the first `mark`; both sides must have something.
Edit with_value(EditKind kind, const std::string& text, const std::string& rest, char mark) {
  const std::size_t at = rest.find(mark);
  if (at == std::string::npos || at == 0 || at + 1 == rest.size()) refuse(text, std::string("expected ") + kForms);
  return {kind, rest.substr(0, at), rest.substr(at + 1)};
}

bool names(const Edit& edit, const std::string& object) {
  return edit.name == object || (edit.kind == EditKind::kSwap && edit.value == object);
}

}  // namespace

bool contradict(const Edit& a, const Edit& b) {
  const bool shared = names(a, b.name) || (b.kind == EditKind::kSwap && names(a, b.value));
  return shared && (a.kind == b.kind || a.kind == EditKind::kRemove || b.kind == EditKind::kRemove);
}

Edit parse_edit(const std::string& text) {
  const std::size_t colon = text.find(':');
  const std::string kind = text.substr(0, colon);
  const std::string rest = with_spaces(colon == std::string::npos ? "" : text.substr(colon + 1));
  if (kind == "color") return with_value(EditKind::kColor, text, rest, '=');
  if (kind == "state") return with_value(EditKind::kState, text, rest, '=');
  if (kind == "remove" && !rest.empty() && rest.find_first_of("=,") == std::string::npos)
    return {EditKind::kRemove, rest, ""};
  if (kind != "swap") refuse(text, std::string("expected ") + kForms);
  Edit swap = with_value(EditKind::kSwap, text, rest, ',');
  if (swap.value < swap.name) std::swap(swap.name, swap.value);
  if (swap.value == swap.name) refuse(text, "expected two objects, not one twice");
  return swap;
}

std::string to_text(const Edit& edit) {
  switch (edit.kind) {
    case EditKind::kColor: return without_spaces("color:" + edit.name + "=" + edit.value);
    case EditKind::kState: return without_spaces("state:" + edit.name + "=" + edit.value);
    case EditKind::kRemove: return without_spaces("remove:" + edit.name);
    case EditKind::kSwap: return without_spaces("swap:" + edit.name + "," + edit.value);
  }
  return {};
}

std::vector<Edit> parse_edits(const std::vector<std::string>& texts) {
  std::vector<Edit> edits;
  edits.reserve(texts.size());
  for (const std::string& text : texts) edits.push_back(parse_edit(text));
  std::sort(edits.begin(), edits.end(), [](const Edit& a, const Edit& b) { return to_text(a) < to_text(b); });
  for (std::size_t i = 0; i < edits.size(); ++i) {
    for (std::size_t j = 0; j < i; ++j) {
      if (contradict(edits[j], edits[i]))
        refuse(to_text(edits[i]), "contradicts '" + to_text(edits[j]) + "'; keep one of them");
    }
  }
  return edits;
}

}  // namespace wiw::apartment
