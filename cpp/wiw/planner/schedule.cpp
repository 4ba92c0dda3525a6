// SPDX-License-Identifier: Apache-2.0
#include <algorithm>
#include <map>

#include "wiw/planner/batch.hpp"

namespace wiw::planner {

/// Sorts the rows into calls: by position in the plan, then, for models of any length that look ahead, by length
/// (padding would change what they imagine).
void Batch::schedule() {
  places_.assign(rows_.size(), {});
  for (int first = 0;; first += spec_.steps()) {
    std::map<int, std::vector<int>, std::greater<>> by_length;
    bool any = false;
    for (std::size_t r = 0; r < rows_.size(); ++r) {
      const int length = static_cast<int>(rows_[r].actions.size());
      if (length <= first) continue;
      any = true;
      const int end = spec_.steps() == 0 ? length : std::min(length, first + spec_.steps());
      places_[r].emplace_back();
      if (std::max(rows_[r].shared, rows_[r].unread) >= end) continue;  // answered by an earlier row, or read by nobody
      by_length[spec_.steps() == 0 && !spec_.causal ? length : 0].push_back(static_cast<int>(r));
    }
    for (auto& [length, rows] : by_length) add_calls(first, rows);
    if (!any || spec_.steps() == 0) return;
  }
}

void Batch::add_calls(int first, const std::vector<int>& rows) {
  const std::size_t most = spec_.max_rows == 0 ? rows.size() : static_cast<std::size_t>(spec_.max_rows);
  for (std::size_t begin = 0; begin < rows.size(); begin += most) {
    const auto from = rows.begin() + static_cast<std::ptrdiff_t>(begin);
    const std::vector<int> some(from, from + static_cast<std::ptrdiff_t>(std::min(most, rows.size() - begin)));
    int steps = spec_.steps();
    if (steps == 0) {
      for (const int r : some)
        steps = std::max(steps, static_cast<int>(rows_[static_cast<std::size_t>(r)].actions.size()));
    }
    add_call(first, steps, some);
  }
}

void Batch::add_call(int first, int steps, const std::vector<int>& rows) {
  ModelCall call{.first = first, .steps = steps, .rows = rows};
  for (std::size_t i = 0; i < rows.size(); ++i) {
    const Row& row = rows_[static_cast<std::size_t>(rows[i])];
    const int length = std::min(steps, static_cast<int>(row.actions.size()) - first);
    const std::span<const action::Action> own(row.actions.data() + first, static_cast<std::size_t>(length));
    call.actions.push_back(action::pad(own, static_cast<std::size_t>(steps), spec_.padding));
    call.length.push_back(length);
    const bool here = row.parent >= rows.front() && std::find(rows.begin(), rows.end(), row.parent) != rows.end();
    call.shared.push_back(std::clamp(std::max(here ? row.shared : 0, row.unread) - first, 0, length));
    if (first > 0) call.start.push_back(canonical({rows[i], first}));
    places_[static_cast<std::size_t>(rows[i])].back() = {static_cast<int>(calls_.size()), static_cast<int>(i), 0};
  }
  calls_.push_back(std::move(call));
}

}  // namespace wiw::planner
