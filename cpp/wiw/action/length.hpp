// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstddef>
#include <span>
#include <string>
#include <vector>

#include "wiw/action/action.hpp"

namespace wiw::action {

/// What fills a discrete plan that is shorter than a model's length: forward steps (models saw motion in training),
/// the plan's last action again, or the null token.
enum class Padding { kForward, kRepeat, kNull };

Padding to_padding(const std::string& name);

/// The plan filled to `length`. Throws ArgumentError if it is longer (chunk it) or if kRepeat has nothing to repeat.
ActionSequence pad(std::span<const Action> actions, std::size_t length, Padding padding);

/// The plan cut into pieces of `length`, the last one padded. An empty plan has no pieces.
std::vector<ActionSequence> chunk(std::span<const Action> actions, std::size_t length, Padding padding);

/// How a plan of any length was brought to a model that makes a fixed number of frames.
enum class Fit { kPad, kResample, kChunk };

/// Where the observation after an action is found: the chunk, and the frame in it (frame 0 is what the chunk began
/// with).
struct FrameIndex {
  int chunk = 0;
  int frame = 0;
};

/// For each of `count` actions, the frame of a model with `frames` frames that shows the outcome. Padded: frame k for
/// the k-th action. Resampled from the start over the whole clip: the nearest of evenly spaced moments. Chunked: each
/// chunk answers `frames` - 1 actions. Throws ArgumentError if frames < 2, for numbers from 2^31 on,
/// and if a padded plan does not fit.
std::vector<FrameIndex> frames_of_actions(std::size_t count, std::size_t frames, Fit fit);

}  // namespace wiw::action
