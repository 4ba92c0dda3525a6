// SPDX-License-Identifier: Apache-2.0
#include "wiw/action/vocabulary.hpp"

#include <algorithm>
#include <cmath>
#include <string>

#include "wiw/core/error.hpp"

namespace wiw::action {

Vocabulary::Vocabulary(const std::map<Action, std::vector<double>>& entries) {
  if (entries.empty()) throw ArgumentError("vocabulary: expected at least one action, got none");
  width_ = entries.begin()->second.size();
  for (const auto& [action, values] : entries) {
    if (values.empty() || values.size() != width_) {
      throw ArgumentError(std::string("vocabulary: expected entries of one width, got ") + std::to_string(width_) +
                          " and, for " + action_name(action) + ", " + std::to_string(values.size()));
    }
    if (!std::all_of(values.begin(), values.end(), [](double v) { return std::isfinite(v); })) {
      throw ArgumentError(std::string("vocabulary: the entry of ") + action_name(action) + " is not finite");
    }
    entries_[static_cast<std::size_t>(action)] = values;
  }
}

std::vector<double> Vocabulary::encode(std::span<const Action> actions) const {
  std::vector<double> encoded;
  encoded.reserve(actions.size() * width_);
  for (const Action action : actions) {
    const auto& values = entries_[static_cast<std::size_t>(action)];
    if (values.empty()) {
      std::string known;
      for (int id = 0; id < kActionCount; ++id) {
        if (entries_[static_cast<std::size_t>(id)].empty()) continue;
        known += (known.empty() ? "" : ", ") + std::string(action_name(static_cast<Action>(id)));
      }
      throw ArgumentError(std::string("the model's vocabulary has no entry for '") + action_name(action) +
                          "' (it knows " + known + "): add one, or leave the action out of the plan");
    }
    encoded.insert(encoded.end(), values.begin(), values.end());
  }
  return encoded;
}

}  // namespace wiw::action
