// SPDX-License-Identifier: Apache-2.0
#include "wiw/annotate/strip.hpp"

#include <doctest/doctest.h>

#include <vector>

#include "wiw/core/error.hpp"

using namespace wiw;
using namespace wiw::annotate;

TEST_CASE("a layout leaves a bar above and gaps between frames") {
  const StripLayout layout({30, 50}, 5, {.columns = 2, .bar = 10, .gap = 3});
  CHECK(layout.size() == Size{3 * 40 + 2 * 3, 2 * 50 + 3});
  CHECK(layout.corner(0) == Size{0, 0});
  CHECK(layout.corner(3) == Size{43, 53});
  CHECK(StripLayout({30, 50}, 5, {}).size().width == 5 * 50 + 4 * 4);
  CHECK_THROWS_AS(StripLayout({30, 50}, 0, {}), ArgumentError);
  CHECK_THROWS_AS(StripLayout({30, 50}, 1, {.columns = -1}), ArgumentError);
}

TEST_CASE("drawing beyond the image touches nothing outside it") {
  const Size size{20, 30};
  std::vector<std::uint8_t> memory(3 * (size.pixels() + 2 * 30), 77);
  const Image image{memory.data() + 3 * 30, size, 3};
  draw_box(image, {-100, -100, 1000, 1000}, {1, 2, 3}, 200, "far out");
  draw_mark(image, {29.5, 19.5}, {1, 2, 3}, 15, "corner");
  draw_axes(image, {15, 10}, {Point{500, 10}, Point{15, -500}, Point{-500, 500}}, 3);
  for (std::size_t i = 0; i < 3 * 30; ++i) {
    CHECK(memory[i] == 77);
    CHECK(memory[memory.size() - 1 - i] == 77);
  }
}
