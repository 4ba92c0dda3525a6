// SPDX-License-Identifier: Apache-2.0
#include "wiw/reproject/fill.hpp"

#include <doctest/doctest.h>

#include <vector>

#include "wiw/reproject/raster.hpp"

using namespace wiw;
using namespace wiw::reproject;

namespace {

constexpr float kHole = kNothing;

struct Filled {
  std::vector<int> color;  // first channel
  std::vector<float> depth;
};

Filled fill(int height, const std::vector<int>& color, std::vector<float> depth, bool wraps) {
  std::vector<std::uint8_t> pixels;
  for (const int value : color) pixels.insert(pixels.end(), 3, static_cast<std::uint8_t>(value));
  const Size size{height, static_cast<int>(color.size()) / height};
  fill_holes({pixels.data(), size, 3}, {depth.data(), size, 1}, wraps);
  Filled filled{{}, depth};
  for (std::size_t i = 0; i < pixels.size(); i += 3) filled.color.push_back(pixels[i]);
  return filled;
}

}  // namespace

TEST_CASE("a gap takes the farther side") {
  const Filled filled = fill(1, {10, 0, 0, 90}, {1, kHole, kHole, 3}, false);
  CHECK(filled.color == std::vector<int>{10, 90, 90, 90});
  CHECK(filled.depth == std::vector<float>{1, 3, 3, 3});
}

TEST_CASE("a gap within one surface is blended") {
  const Filled filled = fill(1, {10, 0, 0, 0, 90}, {2, kHole, kHole, kHole, 2}, false);
  CHECK(filled.color == std::vector<int>{10, 30, 50, 70, 90});
}

TEST_CASE("gaps at the ends wrap around in a panorama and copy the edge in a view") {
  CHECK(fill(1, {0, 40, 70, 0}, {kHole, 1, 5, kHole}, true).color == std::vector<int>{70, 40, 70, 70});
  CHECK(fill(1, {0, 40, 70, 0}, {kHole, 1, 5, kHole}, false).color == std::vector<int>{40, 40, 70, 70});
}

TEST_CASE("empty rows copy the nearest row, an empty image turns black") {
  const Filled rows = fill(4, {0, 0, 5, 6, 0, 0, 0, 0}, {kHole, kHole, 1, 1, kHole, kHole, kHole, kHole}, true);
  CHECK(rows.color == std::vector<int>{5, 6, 5, 6, 5, 6, 5, 6});
  const Filled nothing = fill(1, {9, 9}, {kHole, kHole}, true);
  CHECK(nothing.color == std::vector<int>{0, 0});
  CHECK(nothing.depth == std::vector<float>{0, 0});
}
