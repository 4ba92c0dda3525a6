// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <span>

#include "wiw/annotate/draw.hpp"

namespace wiw::annotate {

struct StripStyle {
  int columns = 0;  // frames in a row, 0 for all
  int bar = 0;      // height of the title bars, 0 for one that suits the frames' width
  int gap = 4;      // pixels between frames
};

/// Layout of `count` frames with a title bar above each, in rows from left to right.
class StripLayout {
 public:
  StripLayout(const Size& frame, std::size_t count, const StripStyle& style);

  [[nodiscard]] const Size& size() const { return size_; }
  [[nodiscard]] int bar() const { return bar_; }
  /// Upper left corner of frame k's title bar.
  [[nodiscard]] Size corner(std::size_t k) const;

 private:
  Size frame_, size_;
  std::size_t columns_;
  int bar_, gap_;
};

/// Draws frames [T, H, W, 3] with one title each into `out`, an image of the layout's size.
void draw_strip(const std::uint8_t* frames, const Size& frame, std::span<const std::string> titles,
                const StripStyle& style, std::uint8_t* out);

}  // namespace wiw::annotate
