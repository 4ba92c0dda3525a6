// SPDX-License-Identifier: Apache-2.0
#include "wiw/planner/assemble.hpp"

#include <cstring>
#include <map>
#include <string>
#include <tuple>

#include "wiw/core/error.hpp"
#include "wiw/core/thread_pool.hpp"

namespace wiw::planner {

namespace {

void convert(const Batch& batch, const ViewIndex::Distinct& distinct, const Panoramas& real,
             const Imagination& imagined, const ViewMaker& maker, std::uint8_t* out) {
  const Source& source = distinct.source;
  if (source.row < 0) {
    const std::uint8_t* panorama = real.images[static_cast<std::size_t>(distinct.episode)];
    maker.from_panorama(panorama, real.size, source.frame * batch.spec().space.turn_rad, out);
    return;
  }
  const Batch::FrameAddress place = batch.place(source);
  const CallFrames& rollout = imagined.rollouts[static_cast<std::size_t>(place.call)];
  const std::uint8_t* pixels = rollout.data + place.index * rollout.row_stride + place.frame * rollout.frame_stride;
  if (imagined.kind == FrameKind::kPanorama) {
    maker.from_panorama(pixels, rollout.size, 0, out);
  } else {
    maker.from_perspective(pixels, rollout.size, out);
  }
}

}  // namespace

ViewIndex index_views(const Batch& batch) {
  ViewIndex index;
  index.steps = batch.longest();
  index.cells.assign(batch.candidates() * index.steps, -1);
  std::map<std::tuple<int, int, int>, int> known;
  for (std::size_t candidate = 0; candidate < batch.candidates(); ++candidate) {
    const int episode = batch.episodes()[candidate];
    const auto& sources = batch.sources(candidate);
    for (std::size_t step = 0; step < sources.size(); ++step) {
      const auto [found, fresh] =
          known.try_emplace({episode, sources[step].row, sources[step].frame}, static_cast<int>(index.distinct.size()));
      if (fresh) index.distinct.push_back({episode, sources[step]});
      index.cells[candidate * index.steps + step] = found->second;
    }
  }
  return index;
}

ViewIndex index_ends(const Batch& batch, std::span<const std::int64_t> candidates) {
  ViewIndex index;
  for (const std::int64_t candidate : candidates) {
    const auto i = static_cast<std::size_t>(candidate);
    if (candidate < 0 || i >= batch.candidates() || batch.sources(i).empty()) {
      throw ArgumentError("index_ends: expected candidates from 0 to " + std::to_string(batch.candidates()) +
                          " (exclusive) that have steps, got " + std::to_string(candidate));
    }
    index.distinct.push_back({batch.episodes()[i], batch.sources(i).back()});
  }
  return index;
}

void check_inputs(const Batch& batch, const Panoramas& real, const Imagination& imagined) {
  for (const int episode : batch.episodes()) {
    if (static_cast<std::size_t>(episode) >= real.images.size()) {
      throw ArgumentError("expected one panorama an episode, got " + std::to_string(real.images.size()) +
                          " and plans for episode " + std::to_string(episode));
    }
  }
  if (imagined.rollouts.size() != batch.calls().size()) {
    throw ArgumentError("expected one rollout for each of the batch's " + std::to_string(batch.calls().size()) +
                        " parts, got " + std::to_string(imagined.rollouts.size()));
  }
  for (std::size_t i = 0; i < imagined.rollouts.size(); ++i) {
    const ModelCall& call = batch.calls()[i];
    const CallFrames& rollout = imagined.rollouts[i];
    if (rollout.rows != call.rows.size() || rollout.frames != static_cast<std::size_t>(call.steps) + 1) {
      throw ArgumentError("rollout of part " + std::to_string(i) + ": expected " + std::to_string(call.rows.size()) +
                          " rows of " + std::to_string(call.steps + 1) +
                          " frames (the observation and one an action), got " + std::to_string(rollout.rows) +
                          " rows of " + std::to_string(rollout.frames));
    }
  }
}

void make_views(const Batch& batch, const ViewIndex& index, const Panoramas& real, const Imagination& imagined,
                const ViewMaker& maker, std::uint8_t* out) {
  check_inputs(batch, real, imagined);
  parallel_for(index.distinct.size(), [&](std::size_t i) {
    convert(batch, index.distinct[i], real, imagined, maker, out + i * maker.bytes());
  });
}

void make_dense_views(const Batch& batch, const ViewIndex& index, const Panoramas& real, const Imagination& imagined,
                      const ViewMaker& maker, std::uint8_t* out) {
  check_inputs(batch, real, imagined);
  const std::size_t bytes = maker.bytes();
  std::vector<std::vector<std::size_t>> cells(index.distinct.size());
  std::vector<std::size_t> empty;
  for (std::size_t cell = 0; cell < index.cells.size(); ++cell) {
    const int view = index.cells[cell];
    (view < 0 ? empty : cells[static_cast<std::size_t>(view)]).push_back(cell);
  }
  parallel_for(cells.size() + empty.size(), [&](std::size_t i) {
    if (i >= cells.size()) {
      std::memset(out + empty[i - cells.size()] * bytes, 0, bytes);
      return;
    }
    std::uint8_t* const first = out + cells[i].front() * bytes;
    convert(batch, index.distinct[i], real, imagined, maker, first);
    for (std::size_t k = 1; k < cells[i].size(); ++k) std::memcpy(out + cells[i][k] * bytes, first, bytes);
  });
}

void make_observations(const Batch& batch, const Panoramas& real, const ViewMaker& maker, std::uint8_t* out) {
  parallel_for(batch.rows().size(), [&](std::size_t r) {
    const Row& row = batch.rows()[r];
    const std::uint8_t* panorama = real.images[static_cast<std::size_t>(row.episode)];
    maker.from_panorama(panorama, real.size, row.turns * batch.spec().space.turn_rad, out + r * maker.bytes());
  });
}

void make_depths(const Batch& batch, const Distances& distances, const ViewMaker& maker, float* out) {
  parallel_for(batch.rows().size(), [&](std::size_t r) {
    const Row& row = batch.rows()[r];
    const float* panorama = distances.images[static_cast<std::size_t>(row.episode)];
    maker.depth(panorama, distances.size, row.turns * batch.spec().space.turn_rad,
                out + r * maker.spec().size.pixels());
  });
}

}  // namespace wiw::planner
