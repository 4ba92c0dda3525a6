// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstddef>
#include <cstdint>
#include <span>
#include <vector>

#include "wiw/planner/batch.hpp"
#include "wiw/planner/view_maker.hpp"

namespace wiw::planner {

/// Observations of the candidates' steps with repetitions named: cells[candidate * steps + step] is the index of a
/// distinct observation, -1 behind the end of a plan.
struct ViewIndex {
  struct Distinct {
    int episode;
    Source source;
  };
  std::size_t steps = 0;
  std::vector<int> cells;
  std::vector<Distinct> distinct;
};

ViewIndex index_views(const Batch& batch);

/// What each of `candidates` ends with, one distinct observation each, for make_views. Throws ArgumentError for a
/// candidate that is not in the batch or has no steps.
ViewIndex index_ends(const Batch& batch, std::span<const std::int64_t> candidates);

/// One dense image an episode, wherever each lies.
template <class T>
struct EpisodeImages {
  std::vector<const T*> images;
  Size size;
};

/// Real panoramas of the episodes, uint8 [H, W, 3] each.
using Panoramas = EpisodeImages<std::uint8_t>;
/// Their distances, float [H, W] each.
using Distances = EpisodeImages<float>;

/// Frames that the model answered one call with: uint8 [rows, frames, H, W, 3]. Images are dense; rows and frames may
/// lie any number of bytes apart, also none (a model that repeats an image need not copy it).
struct CallFrames {
  const std::uint8_t* data = nullptr;
  std::size_t rows = 0;
  std::size_t frames = 0;
  Size size;
  std::ptrdiff_t row_stride = 0;
  std::ptrdiff_t frame_stride = 0;
};

/// Frames of each call of a batch.
struct Imagination {
  FrameKind kind = FrameKind::kPanorama;
  std::vector<CallFrames> rollouts;
};

/// Throws ArgumentError unless there is one panorama an episode and frames of the right length for each call.
void check_inputs(const Batch& batch, const Panoramas& real, const Imagination& imagined);

/// Views of each distinct observation once, [distinct, bytes of the maker].
void make_views(const Batch& batch, const ViewIndex& index, const Panoramas& real, const Imagination& imagined,
                const ViewMaker& maker, std::uint8_t* out);

/// Views of every candidate and step, [candidates, steps, bytes of the maker], zeros behind the end of a plan. Each
/// distinct observation is converted once and copied to where it repeats.
void make_dense_views(const Batch& batch, const ViewIndex& index, const Panoramas& real, const Imagination& imagined,
                      const ViewMaker& maker, std::uint8_t* out);

/// What each row of the batch begins with: the real panorama after its leading turns, [rows, bytes of the maker].
void make_observations(const Batch& batch, const Panoramas& real, const ViewMaker& maker, std::uint8_t* out);

/// The same for depth, -> [rows, height, width]; see ViewMaker::depth.
void make_depths(const Batch& batch, const Distances& distances, const ViewMaker& maker, float* out);

}  // namespace wiw::planner
