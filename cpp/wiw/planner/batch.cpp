// SPDX-License-Identifier: Apache-2.0
#include "wiw/planner/batch.hpp"

#include <algorithm>
#include <cmath>

#include "wiw/core/error.hpp"

namespace wiw::planner {

namespace {

bool begins_with(const action::ActionSequence& plan, const action::ActionSequence& beginning) {
  return plan.size() >= beginning.size() && std::equal(beginning.begin(), beginning.end(), plan.begin());
}

/// The plan as the model will see it: whole calls, padded.
action::ActionSequence filled(const action::ActionSequence& plan, const ModelSpec& spec) {
  if (spec.steps() == 0 || plan.empty()) return plan;
  const auto steps = static_cast<std::size_t>(spec.steps());
  return action::pad(plan, (plan.size() + steps - 1) / steps * steps, spec.padding);
}

/// Whether a rollout of `row` also answers `plan`.
bool answers(const action::ActionSequence& row, const action::ActionSequence& plan, const ModelSpec& spec) {
  if (spec.causal) return begins_with(row, plan);
  return row == plan || (row.size() >= plan.size() && filled(row, spec) == filled(plan, spec));
}

}  // namespace

void ModelSpec::check() const {
  space.check();
  if (frames < 0 || frames == 1) {
    throw ArgumentError("ModelSpec: expected frames 0 (any) or at least 2 (the observation counts), got " +
                        std::to_string(frames));
  }
  if (max_rows < 0) throw ArgumentError("ModelSpec: expected max_rows of at least 0, got " + std::to_string(max_rows));
}

Batch::Batch(const Plans& plans, const ModelSpec& spec) : spec_(spec) {
  spec_.check();
  for (std::size_t episode = 0; episode < plans.size(); ++episode) {
    std::vector<SplitPlan> splits;
    for (const action::ActionSequence& plan : plans[episode]) {
      splits.push_back(split_leading_turns(plan, spec_.leading, spec_.space));
    }
    merge(splits, static_cast<int>(episode));
  }
  share();
  for (auto& steps : sources_) {
    for (Source& source : steps) source = canonical(source);
  }
  if (spec_.ends) keep_ends();
  schedule();
}

void Batch::merge(const std::vector<SplitPlan>& splits, int episode) {
  const std::size_t first_row = rows_.size();
  const auto find_row = [&](const SplitPlan& split) {
    return std::find_if(rows_.begin() + static_cast<std::ptrdiff_t>(first_row), rows_.end(), [&](const Row& row) {
      return row.turns == split.turns && answers(row.actions, split.rest, spec_);
    });
  };
  // Longest plans first, so that a plan that another begins with finds that other.
  std::vector<std::size_t> order(splits.size());
  for (std::size_t i = 0; i < order.size(); ++i) order[i] = i;
  std::stable_sort(order.begin(), order.end(),
                   [&](std::size_t a, std::size_t b) { return splits[a].rest.size() > splits[b].rest.size(); });
  for (const std::size_t i : order) {
    const SplitPlan& split = splits[i];
    if (split.rest.empty()) continue;
    if (find_row(split) == rows_.end()) rows_.push_back({episode, static_cast<int>(i), split.turns, split.rest});
  }
  std::stable_sort(rows_.begin() + static_cast<std::ptrdiff_t>(first_row), rows_.end(),
                   [](const Row& a, const Row& b) { return a.candidate < b.candidate; });
  for (const SplitPlan& split : splits) {
    std::vector<Source> steps;
    steps.reserve(split.rolled.size() + split.rest.size());
    for (const int turns : split.rolled) steps.push_back({-1, turns});
    const int row = split.rest.empty() ? -1 : static_cast<int>(find_row(split) - rows_.begin());
    for (std::size_t k = 0; k < split.rest.size(); ++k) steps.push_back({row, static_cast<int>(k) + 1});
    sources_.push_back(std::move(steps));
    episodes_.push_back(episode);
  }
}

int Batch::common_frames(const Row& earlier, const Row& later) const {
  if (earlier.episode != later.episode || earlier.turns != later.turns) return 0;
  const auto common = [](const action::ActionSequence& a, const action::ActionSequence& b) {
    return static_cast<int>(std::mismatch(a.begin(), a.end(), b.begin(), b.end()).first - a.begin());
  };
  if (spec_.causal) return common(earlier.actions, later.actions);
  // A call of a model that looks ahead is shared whole or not at all.
  if (spec_.steps() == 0) return 0;
  return common(filled(earlier.actions, spec_), filled(later.actions, spec_)) / spec_.steps() * spec_.steps();
}

void Batch::share() {
  std::size_t first = 0;  // row of the episode
  for (std::size_t later = 0; later < rows_.size(); ++later) {
    if (rows_[first].episode != rows_[later].episode) first = later;
    for (std::size_t earlier = first; earlier < later; ++earlier) {
      const int common = common_frames(rows_[earlier], rows_[later]);
      if (common > rows_[later].shared) {
        rows_[later].parent = static_cast<int>(earlier);
        rows_[later].shared = common;
      }
    }
  }
}

/// Drops all but the last step of each candidate. Where one call answers a row, frames before those are unread; a later
/// call begins with one of them.
void Batch::keep_ends() {
  for (Row& row : rows_) row.unread = static_cast<int>(row.actions.size());
  for (auto& steps : sources_) {
    if (steps.size() > 1) steps.erase(steps.begin(), steps.end() - 1);
    if (steps.empty() || steps.back().row < 0) continue;
    int& unread = rows_[static_cast<std::size_t>(steps.back().row)].unread;
    unread = std::min(unread, steps.back().frame - 1);
  }
  for (Row& row : rows_) {
    if (spec_.steps() > 0 && static_cast<int>(row.actions.size()) > spec_.steps()) row.unread = 0;
  }
}

Source Batch::canonical(Source source) const {
  while (source.row >= 0 && source.frame <= rows_[static_cast<std::size_t>(source.row)].shared) {
    source.row = rows_[static_cast<std::size_t>(source.row)].parent;
  }
  return source;
}

std::size_t Batch::longest() const {
  std::size_t steps = 0;
  for (const auto& sources : sources_) steps = std::max(steps, sources.size());
  return steps;
}

Batch::FrameAddress Batch::place(const Source& source) const {
  const int call = spec_.steps() == 0 ? 0 : (source.frame - 1) / spec_.steps();
  FrameAddress place = places_[static_cast<std::size_t>(source.row)][static_cast<std::size_t>(call)];
  place.frame = source.frame - calls_[static_cast<std::size_t>(place.call)].first;
  return place;
}

}  // namespace wiw::planner
