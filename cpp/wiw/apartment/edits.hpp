// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <string>
#include <vector>

#include "wiw/apartment/draft.hpp"

namespace wiw::apartment {

enum class EditKind { kColor, kRemove, kState, kSwap };

/// One counterfactual change. As text, with "_" or "+" for spaces: "color:sofa_1=blue", "state:curtain_2=half_drawn",
/// "remove:vase_1", "swap:plant_1,floor_lamp_1". Where several doors or windows have one name, ".2" is the second.
struct Edit {
  EditKind kind = EditKind::kColor;
  std::string name;   // of an instance
  std::string value;  // colour, state, or the other instance's name
  bool operator==(const Edit&) const = default;
};

/// Throws ArgumentError where the text is no edit.
Edit parse_edit(const std::string& text);
std::string to_text(const Edit& edit);
/// Whether two edits of one object cannot be combined: two of a kind, or anything with its removal.
bool contradict(const Edit& a, const Edit& b);
/// Edits in their canonical order, whatever the given one; ArgumentError where two contradict each other.
std::vector<Edit> parse_edits(const std::vector<std::string>& texts);

/// Applies canonical edits to a furnished draft with balanced lights: objects go first, then places, states and
/// colours change. Nothing else changes. ArgumentError says what is possible instead.
void apply_edits(Draft& draft, const std::vector<Edit>& edits);
/// Edits that could be added to those that were applied to the draft.
std::vector<Edit> possible_edits(const Draft& draft, const std::vector<Edit>& applied);

}  // namespace wiw::apartment
