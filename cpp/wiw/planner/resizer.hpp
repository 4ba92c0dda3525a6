// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstdint>
#include <vector>

#include "wiw/core/image.hpp"

namespace wiw::planner {

/// What stays when an image is resized.
enum class Keep {
  kSphere,     // everything: each axis for itself, and columns close to a circle
  kDirection,  // width and middle, on square pixels: rows are cut off or, where there are none, black
};

/// Resizes three-channel bytes: by area average where the image shrinks, linearly (pixel centres at half integers)
/// where it grows. Weights are exact fractions, so the result is the true mean, rounded.
class Resizer {
 public:
  /// Throws ArgumentError for empty sizes.
  Resizer(Size from, Size to, Keep keep);

  /// Columns of `source` are read as if it had been rolled to the right by `shift` in [0, width). Safe to call from
  /// several threads.
  void operator()(const std::uint8_t* source, int shift, std::uint8_t* out) const;

  [[nodiscard]] Size from() const { return from_; }
  [[nodiscard]] Size to() const { return to_; }

 private:
  struct Tap {
    int index;
    std::uint16_t weight;
  };
  /// Output i is the sum over taps[begin[i] .. begin[i + 1]) divided by `total`.
  struct AxisTaps {
    std::vector<Tap> taps;
    std::vector<std::size_t> begin;
    std::uint32_t total = 0;
  };
  /// `in` of the `from` input pixels become `out` of the `to` output pixels, and the middle stays the middle.
  static AxisTaps make_axis(int from, int to, int in, int out, bool wrap);
  static AxisTaps averages(int from, int to, int in, int out);
  static AxisTaps interpolations(int from, int to, int in, int out, bool wrap);

  Size from_;
  Size to_;
  AxisTaps rows_;
  AxisTaps columns_;
};

}  // namespace wiw::planner
