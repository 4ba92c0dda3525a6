// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstddef>
#include <vector>

#include "wiw/planner/leading_turns.hpp"

namespace wiw::planner {

/// Candidate plans of every live episode: plans[episode][candidate].
using Plans = std::vector<std::vector<action::ActionSequence>>;

/// One future the model imagines. Several candidates may read it.
struct Row {
  int episode = 0;
  int candidate = 0;               // the candidate it was made for, the lowest of equal ones; its seed is used
  int turns = 0;                   // the observation is the real panorama after this many left turns
  action::ActionSequence actions;  // from there on, without padding
  int parent = -1;                 // earlier row that begins alike,
  int shared = 0;                  // for this many frames
  int unread = 0;                  // leading frames that nobody reads
};

/// Where the observation after one step of a candidate comes from.
struct Source {
  int row = -1;   // -1: the real panorama
  int frame = 0;  // of the row, 0 being its observation; for the real panorama the number of left turns
  bool operator==(const Source&) const = default;
};

/// One call of the model: rows of equal length. A plan longer than the model's rollout takes part in several calls,
/// each beginning at the frame the last one ended with.
struct ModelCall {
  int first = 0;                                // frame of the rows at which the call begins
  int steps = 0;                                // actions of each row in this call
  std::vector<int> rows;                        // index into Batch::rows
  std::vector<action::ActionSequence> actions;  // padded to `steps`
  std::vector<int> length;                      // actions that are the plan's own
  std::vector<int> shared;    // leading frames of this call answered by an earlier row of it, or read by nobody
  std::vector<Source> start;  // frame that the call begins with; only where first > 0
};

/// The smallest set of rollouts that answers all candidates of one decision. Within an episode equal plans are merged,
/// leading turns are left to the real panorama and, for causal models, plans that another one begins with are merged
/// and common beginnings marked. Episodes never mix, so a row does not depend on what else is in the batch.
class Batch {
 public:
  Batch(const Plans& plans, const ModelSpec& spec);

  [[nodiscard]] const ModelSpec& spec() const { return spec_; }
  [[nodiscard]] const std::vector<Row>& rows() const { return rows_; }
  [[nodiscard]] const std::vector<ModelCall>& calls() const { return calls_; }

  /// Candidates of all episodes in order.
  [[nodiscard]] std::size_t candidates() const { return sources_.size(); }
  [[nodiscard]] const std::vector<int>& episodes() const { return episodes_; }
  /// Sources of the candidate's steps, of the last one alone where only ends are read; a frame that several rows share
  /// is named by the row that answers it.
  [[nodiscard]] const std::vector<Source>& sources(std::size_t candidate) const { return sources_[candidate]; }
  [[nodiscard]] std::size_t longest() const;

  /// Call, index in it and frame of it that hold an imagined frame (frame > 0).
  struct FrameAddress {
    int call = 0;
    int index = 0;
    int frame = 0;
  };
  [[nodiscard]] FrameAddress place(const Source& source) const;

 private:
  void merge(const std::vector<SplitPlan>& splits, int episode);
  void share();
  void keep_ends();
  void schedule();
  void add_calls(int first, const std::vector<int>& rows);
  void add_call(int first, int steps, const std::vector<int>& rows);
  [[nodiscard]] Source canonical(Source source) const;
  [[nodiscard]] int common_frames(const Row& earlier, const Row& later) const;

  ModelSpec spec_;
  std::vector<Row> rows_;
  std::vector<ModelCall> calls_;
  std::vector<int> episodes_;
  std::vector<std::vector<Source>> sources_;
  std::vector<std::vector<FrameAddress>> places_;  // per row and call: where its frames lie
};

}  // namespace wiw::planner
