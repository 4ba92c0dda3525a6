// SPDX-License-Identifier: Apache-2.0
#include "wiw/action/length.hpp"

#include <cmath>
#include <limits>

#include "wiw/core/error.hpp"

namespace wiw::action {

Padding to_padding(const std::string& name) {
  if (name == "forward") return Padding::kForward;
  if (name == "repeat") return Padding::kRepeat;
  if (name == "null") return Padding::kNull;
  throw ArgumentError("padding: expected 'forward', 'repeat' or 'null', got '" + name + "'");
}

ActionSequence pad(std::span<const Action> actions, std::size_t length, Padding padding) {
  if (actions.size() > length) {
    throw ArgumentError("pad: expected a plan of at most " + std::to_string(length) + " actions, got " +
                        std::to_string(actions.size()) + ": roll a longer plan out in chunks");
  }
  if (padding == Padding::kRepeat && actions.empty() && length > 0) {
    throw ArgumentError("pad: an empty plan has no action to repeat; pad with 'forward' or 'null'");
  }
  ActionSequence padded(actions.begin(), actions.end());
  Action filler = Action::kForward;
  if (padding == Padding::kNull) filler = Action::kNull;
  if (padding == Padding::kRepeat && !actions.empty()) filler = actions.back();
  padded.resize(length, filler);
  return padded;
}

std::vector<ActionSequence> chunk(std::span<const Action> actions, std::size_t length, Padding padding) {
  if (length == 0) throw ArgumentError("chunk: expected a length of at least 1, got 0");
  std::vector<ActionSequence> chunks;
  for (std::size_t begin = 0; begin < actions.size(); begin += length) {
    chunks.push_back(pad(actions.subspan(begin, std::min(length, actions.size() - begin)), length, padding));
  }
  return chunks;
}

std::vector<FrameIndex> frames_of_actions(std::size_t count, std::size_t frames, Fit fit) {
  constexpr std::size_t kMost = std::numeric_limits<int>::max();
  if (frames < 2 || frames > kMost || count > kMost) {
    throw ArgumentError(
        "frames_of_actions: expected at least 2 frames (the observation and one more) and numbers "
        "below 2^31, got " +
        std::to_string(frames) + " frames and " + std::to_string(count) + " actions");
  }
  const std::size_t steps = frames - 1;
  if (fit == Fit::kPad && count > steps) {
    throw ArgumentError("frames_of_actions: " + std::to_string(count) + " actions do not fit " +
                        std::to_string(frames) + " frames: chunk the plan, or resample poses");
  }
  std::vector<FrameIndex> found(count);
  for (std::size_t k = 0; k < count; ++k) {
    if (fit == Fit::kChunk) {
      found[k] = {static_cast<int>(k / steps), static_cast<int>(k % steps) + 1};
    } else if (fit == Fit::kPad) {
      found[k] = {0, static_cast<int>(k) + 1};
    } else {
      const double moment = static_cast<double>(k + 1) * static_cast<double>(steps) / static_cast<double>(count);
      found[k] = {0, static_cast<int>(std::nearbyint(moment))};
    }
  }
  return found;
}

}  // namespace wiw::action
