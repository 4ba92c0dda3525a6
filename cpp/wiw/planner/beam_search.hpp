// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <vector>

#include "wiw/planner/batch.hpp"

namespace wiw::planner {

/// Policy-guided beam search over the plans of many episodes (the paper's "Unified Strategy for Closed-Loop Online
/// Planning"): ask for the plans to score, tell their scores; each level keeps the best `width` plans of an episode and
/// the next one extends them. With depth 1 the candidates are the proposals.
class BeamSearch {
 public:
  /// Throws ArgumentError unless both are at least 1.
  BeamSearch(int width, int depth = 1);

  struct Entry {
    action::ActionSequence plan;
    double score = 0;
    int origin = 0;  // first-level proposal that the plan began as
  };

  /// Level 1: the proposals of each episode are the candidates.
  const Plans& ask(const Plans& proposals);
  /// Deeper levels: continuations[episode][beam entry] are plans to append. Candidates are ordered by beam entry; an
  /// empty continuation keeps the plan as it is.
  const Plans& ask(const std::vector<Plans>& continuations);

  /// Scores of the candidates that were asked for. Returns for each episode the candidates that are kept, best
  /// first; equal scores keep their order. Throws ArgumentError for a wrong number of scores or NaN.
  std::vector<std::vector<int>> tell(const std::vector<std::vector<double>>& scores);

  [[nodiscard]] int level() const { return level_; }  // levels told so far
  [[nodiscard]] bool done() const { return level_ == depth_; }
  /// Kept plans of each episode, best first; one without candidates has none.
  [[nodiscard]] const std::vector<std::vector<Entry>>& beams() const { return beams_; }

 private:
  void expect(bool asking) const;
  const Plans& publish();

  int width_;
  int depth_;
  int level_ = 0;
  bool asked_ = false;
  std::vector<std::vector<Entry>> beams_;
  std::vector<std::vector<Entry>> candidates_;
  Plans plans_;
};

}  // namespace wiw::planner
