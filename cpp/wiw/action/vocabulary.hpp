// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <array>
#include <map>
#include <span>
#include <vector>

#include "wiw/action/action.hpp"

namespace wiw::action {

/// A model's own words for the primitives: each known action has one id or one vector, all of the same width.
class Vocabulary {
 public:
  /// Throws ArgumentError if empty, if widths differ or a number is not finite.
  explicit Vocabulary(const std::map<Action, std::vector<double>>& entries);

  [[nodiscard]] std::size_t width() const { return width_; }

  /// Row-major [actions, width]. Throws ArgumentError for an action without an entry.
  [[nodiscard]] std::vector<double> encode(std::span<const Action> actions) const;

 private:
  std::size_t width_ = 0;
  std::array<std::vector<double>, kActionCount> entries_;  // empty: unknown to the model
};

}  // namespace wiw::action
