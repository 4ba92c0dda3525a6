// SPDX-License-Identifier: Apache-2.0
#include "wiw/planner/beam_search.hpp"

#include <algorithm>
#include <cmath>
#include <numeric>
#include <string>

#include "wiw/core/error.hpp"

namespace wiw::planner {

BeamSearch::BeamSearch(int width, int depth) : width_(width), depth_(depth) {
  if (width < 1 || depth < 1) {
    throw ArgumentError("BeamSearch: expected a width and a depth of at least 1, got " + std::to_string(width) +
                        " and " + std::to_string(depth));
  }
}

void BeamSearch::expect(bool asking) const {
  if (asking && done()) throw ArgumentError("BeamSearch: all " + std::to_string(depth_) + " levels are done");
  if (asking == asked_) throw ArgumentError("BeamSearch: expected ask() and tell() in turn");
}

const Plans& BeamSearch::publish() {
  plans_.assign(candidates_.size(), {});
  for (std::size_t episode = 0; episode < candidates_.size(); ++episode) {
    for (const Entry& entry : candidates_[episode]) plans_[episode].push_back(entry.plan);
  }
  asked_ = true;
  return plans_;
}

const Plans& BeamSearch::ask(const Plans& proposals) {
  expect(true);
  if (level_ > 0) throw ArgumentError("BeamSearch: after the first level ask with continuations of each kept plan");
  candidates_.assign(proposals.size(), {});
  for (std::size_t episode = 0; episode < proposals.size(); ++episode) {
    for (std::size_t i = 0; i < proposals[episode].size(); ++i) {
      candidates_[episode].push_back({proposals[episode][i], 0, static_cast<int>(i)});
    }
  }
  return publish();
}

const Plans& BeamSearch::ask(const std::vector<Plans>& continuations) {
  expect(true);
  if (level_ == 0) throw ArgumentError("BeamSearch: the first level asks with proposals, not continuations");
  if (continuations.size() != beams_.size()) {
    throw ArgumentError("BeamSearch: expected continuations for " + std::to_string(beams_.size()) + " episodes, got " +
                        std::to_string(continuations.size()));
  }
  candidates_.assign(beams_.size(), {});
  for (std::size_t episode = 0; episode < beams_.size(); ++episode) {
    if (continuations[episode].size() != beams_[episode].size()) {
      throw ArgumentError("BeamSearch: expected continuations for the " + std::to_string(beams_[episode].size()) +
                          " kept plans of episode " + std::to_string(episode) + ", got " +
                          std::to_string(continuations[episode].size()));
    }
    for (std::size_t i = 0; i < beams_[episode].size(); ++i) {
      for (const action::ActionSequence& more : continuations[episode][i]) {
        Entry entry = beams_[episode][i];
        entry.plan.insert(entry.plan.end(), more.begin(), more.end());
        candidates_[episode].push_back(std::move(entry));
      }
    }
  }
  return publish();
}

std::vector<std::vector<int>> BeamSearch::tell(const std::vector<std::vector<double>>& scores) {
  expect(false);
  if (scores.size() != candidates_.size()) {
    throw ArgumentError("BeamSearch: expected scores of " + std::to_string(candidates_.size()) + " episodes, got " +
                        std::to_string(scores.size()));
  }
  for (std::size_t episode = 0; episode < scores.size(); ++episode) {
    const std::string where = " of episode " + std::to_string(episode);
    if (scores[episode].size() != candidates_[episode].size()) {
      throw ArgumentError("BeamSearch: expected " + std::to_string(candidates_[episode].size()) + " scores" + where +
                          ", got " + std::to_string(scores[episode].size()));
    }
    for (std::size_t i = 0; i < scores[episode].size(); ++i) {
      if (std::isnan(scores[episode][i])) {
        throw ArgumentError("BeamSearch: the score of candidate " + std::to_string(i) + where +
                            " is NaN; give -inf to a plan that must not be taken");
      }
    }
  }
  std::vector<std::vector<int>> kept(scores.size());
  beams_.assign(scores.size(), {});
  for (std::size_t episode = 0; episode < scores.size(); ++episode) {
    std::vector<int>& order = kept[episode];
    order.resize(scores[episode].size());
    std::iota(order.begin(), order.end(), 0);
    const auto score = [&](int candidate) { return scores[episode][static_cast<std::size_t>(candidate)]; };
    std::stable_sort(order.begin(), order.end(), [&](int a, int b) { return score(a) > score(b); });
    order.resize(std::min(order.size(), static_cast<std::size_t>(width_)));
    for (const int candidate : order) {
      Entry entry = candidates_[episode][static_cast<std::size_t>(candidate)];
      entry.score = score(candidate);
      beams_[episode].push_back(std::move(entry));
    }
  }
  ++level_;
  asked_ = false;
  return kept;
}

}  // namespace wiw::planner
