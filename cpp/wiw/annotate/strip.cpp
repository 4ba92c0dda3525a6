// SPDX-License-Identifier: Apache-2.0
#include "wiw/annotate/strip.hpp"

#include <algorithm>

#include "wiw/core/error.hpp"

namespace wiw::annotate {

namespace {

const Color kPage{255, 255, 255};
const Color kBar{32, 36, 44};
const Color kTitle{245, 245, 245};

void fill_rows(const Image& image, const Size& corner, const Size& area, const Color& color) {
  for (int y = 0; y < area.height; ++y) {
    std::uint8_t* pixel = image.at(corner.height + y, corner.width);
    for (int x = 0; x < area.width; ++x, pixel += 3) std::copy(color.begin(), color.end(), pixel);
  }
}

}  // namespace

StripLayout::StripLayout(const Size& frame, std::size_t count, const StripStyle& style)
    : frame_(frame),
      columns_(style.columns > 0 ? std::min(count, static_cast<std::size_t>(style.columns)) : count),
      bar_(style.bar > 0 ? style.bar : std::clamp(frame.width / 16, 14, 28)),
      gap_(style.gap) {
  if (count == 0 || frame.height < 1 || frame.width < 1) {
    throw ArgumentError("strip: expected at least one frame of at least one pixel");
  }
  if (style.columns < 0 || style.bar < 0 || style.gap < 0) {
    throw ArgumentError("strip: columns, bar and gap must not be negative");
  }
  const auto rows = static_cast<int>((count + columns_ - 1) / columns_);
  const auto columns = static_cast<int>(columns_);
  size_ = {rows * (frame.height + bar_) + (rows - 1) * gap_, columns * frame.width + (columns - 1) * gap_};
}

Size StripLayout::corner(std::size_t k) const {
  const auto row = static_cast<int>(k / columns_);
  const auto column = static_cast<int>(k % columns_);
  return {row * (frame_.height + bar_ + gap_), column * (frame_.width + gap_)};
}

void draw_strip(const std::uint8_t* frames, const Size& frame, std::span<const std::string> titles,
                const StripStyle& style, std::uint8_t* out) {
  const StripLayout layout(frame, titles.size(), style);
  const Image image{out, layout.size(), 3};
  fill_rows(image, {0, 0}, layout.size(), kPage);
  for (std::size_t k = 0; k < titles.size(); ++k) {
    const Size corner = layout.corner(k);
    fill_rows(image, corner, {layout.bar(), frame.width}, kBar);
    const auto left = static_cast<double>(corner.width);
    const auto top = static_cast<double>(corner.height);
    draw_text(image, {left, top, left + frame.width, top + layout.bar()}, titles[k], kTitle, layout.bar() - 6);
    const ImageView<const std::uint8_t> source{frames + 3 * k * frame.pixels(), frame, 3};
    for (int y = 0; y < frame.height; ++y) {
      std::copy_n(source.row(y), 3 * frame.width, image.at(corner.height + layout.bar() + y, corner.width));
    }
  }
}

}  // namespace wiw::annotate
