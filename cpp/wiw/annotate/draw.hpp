// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <array>
#include <cstdint>
#include <string>

#include "wiw/core/image.hpp"

namespace wiw::annotate {

using Color = std::array<std::uint8_t, 3>;
using Image = ImageView<std::uint8_t>;  // three channels, drawn into in place

struct Point {
  double x = 0.0;  // pixels, 0 at the left edge of the first pixel
  double y = 0.0;
};

/// Rectangle between pixel edges. left > right means that it crosses the seam of a panorama and is drawn in two parts.
struct ImageBox {
  double left, top, right, bottom;
};

/// Outline `thickness` pixels wide inside the box, with a label on a plate of the same colour at its upper left corner,
/// moved into the image where it would stick out; an empty label draws none.
void draw_box(Image image, const ImageBox& box, const Color& color, int thickness, const std::string& label);

/// Disc with a light rim, and a label on a dark plate (numbered candidates, the goal), with a line to it: `gap` pixels
/// to its right, or to its left where negative.
void draw_mark(Image image, const Point& center, const Color& color, int radius, const std::string& label, int gap = 2);

/// Arrows from `origin` to three points: x red, y green, z blue, lettered at their ends.
void draw_axes(Image image, const Point& origin, const std::array<Point, 3>& ends, int thickness);

/// Text centred in an area, as large as fits but no higher than `height` pixels; cut with "..." where even the
/// smallest readable size is too wide. Characters beyond ASCII are shown as '?': the built-in font has no others.
void draw_text(Image image, const ImageBox& area, const std::string& text, const Color& color, int height);

/// Throws ArgumentError unless the image has three channels and at least one pixel.
void check_image(const Image& image);

}  // namespace wiw::annotate
