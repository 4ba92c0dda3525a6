// SPDX-License-Identifier: Apache-2.0
#include "wiw/reproject/fill.hpp"

#include <doctest/doctest.h>

#include <algorithm>
#include <cmath>
#include <vector>

#include "wiw/core/rng.hpp"
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

/// Colour of a block without depth by walking out of it in eight directions; one value for a block of 4 x 4 pixels.
double walked(const std::vector<int>& color, const std::vector<float>& depth, int columns, int at, bool wraps) {
  const int rows = static_cast<int>(color.size()) / columns;
  double sum = 0;
  double total = 0;
  for (int down = -1; down <= 1; ++down) {
    for (int right = -1; right <= 1; ++right) {
      if (down == 0 && right == 0) continue;
      for (int steps = 1; steps <= std::max(rows, columns); ++steps) {
        const int row = at / columns + down * steps;
        int column = at % columns + right * steps;
        if (wraps) column = (column + steps * columns) % columns;
        if (row < 0 || row >= rows || column < 0 || column >= columns) break;
        const auto met = static_cast<std::size_t>(row * columns + column);
        if (depth[met] == kHole) continue;
        const double kind = right == 0 ? 1.65 : down == 0 ? 1.0 : 0.55;
        const double weight = kind * std::sqrt(std::min(depth[met], 20.0F)) * std::pow(steps, -0.6);
        sum += weight * color[met];
        total += weight;
        break;
      }
    }
  }
  return sum / total;
}

}  // namespace

TEST_CASE("colour is the weighted mean of what eight directions meet") {
  const int rows = 5;
  const int columns = 7;
  Rng rng(1);
  std::vector<int> color;
  std::vector<float> depth;
  for (int i = 0; i < rows * columns; ++i) {
    color.push_back(static_cast<int>(rng.below(256)));
    depth.push_back(rng.below(10) < 5 ? kHole : static_cast<float>(1 + rng.below(30)));
  }
  std::vector<int> pixel_color;
  std::vector<float> pixel_depth;
  for (int y = 0; y < 4 * rows; ++y) {
    for (int x = 0; x < 4 * columns; ++x) {
      const auto block = static_cast<std::size_t>(y / 4 * columns + x / 4);
      pixel_color.push_back(color[block]);
      pixel_depth.push_back(depth[block]);
    }
  }
  for (const bool wraps : {false, true}) {
    const Filled filled = fill(4 * rows, pixel_color, pixel_depth, wraps);
    // Between the middles of blocks the guess is bilinear; in the middle four pixels it is 1/8 of a block away from it.
    const auto block_value = [&](int row, int column) {
      row = std::clamp(row, 0, rows - 1);
      column = wraps ? (column + columns) % columns : std::clamp(column, 0, columns - 1);
      const int at = row * columns + column;
      return depth[static_cast<std::size_t>(at)] == kHole ? walked(color, depth, columns, at, wraps)
                                                          : color[static_cast<std::size_t>(at)];
    };
    for (int y = 0; y < 4 * rows; ++y) {
      for (int x = 0; x < 4 * columns; ++x) {
        const auto i = static_cast<std::size_t>(y * 4 * columns + x);
        if (pixel_depth[i] != kHole) {
          CHECK(filled.color[i] == pixel_color[i]);
          continue;
        }
        const double v = (y + 0.5) / 4 - 0.5;
        const double u = (x + 0.5) / 4 - 0.5;
        const int row = static_cast<int>(std::floor(v));
        const int column = static_cast<int>(std::floor(u));
        const double top = std::lerp(block_value(row, column), block_value(row, column + 1), u - column);
        const double bottom = std::lerp(block_value(row + 1, column), block_value(row + 1, column + 1), u - column);
        CHECK(std::abs(filled.color[i] - std::lerp(top, bottom, v - row)) <= 0.51);
      }
    }
  }
}

TEST_CASE("within a block the farther pixels count more") {
  // Blocks: a silhouette of a near and a far half, then a hole.
  std::vector<int> color;
  std::vector<float> depth;
  for (int y = 0; y < 4; ++y) {
    for (const int value : {10, 10, 90, 90, 0, 0, 0, 0}) color.push_back(value);
    for (const float z : {1.0F, 1.0F, 3.0F, 3.0F, kHole, kHole, kHole, kHole}) depth.push_back(z);
  }
  CHECK(fill(4, color, depth, false).color[7] == 82);  // (1 x 10 + 9 x 90) / 10
}

TEST_CASE("depth of a gap is the farther side's") {
  CHECK(fill(1, {10, 0, 0, 90}, {1, kHole, kHole, 3}, false).depth == std::vector<float>{1, 3, 3, 3});
}

TEST_CASE("depth of a gap within one surface is blended") {
  const Filled filled = fill(1, {10, 0, 0, 0, 90}, {2, kHole, kHole, kHole, 2.1F}, false);
  CHECK(filled.depth[2] == doctest::Approx(2.05));
}

TEST_CASE("depth at the ends of a row wraps around in a panorama and copies the edge in a view") {
  CHECK(fill(1, {0, 40, 70, 0}, {kHole, 1, 5, kHole}, true).depth == std::vector<float>{5, 1, 5, 5});
  CHECK(fill(1, {0, 40, 70, 0}, {kHole, 1, 5, kHole}, false).depth == std::vector<float>{1, 1, 5, 5});
}

TEST_CASE("rows without depth copy the nearest row's, an empty image turns black") {
  const Filled rows = fill(4, {0, 0, 5, 6, 0, 0, 0, 0}, {kHole, kHole, 1, 2, kHole, kHole, kHole, kHole}, true);
  CHECK(rows.depth == std::vector<float>{1, 2, 1, 2, 1, 2, 1, 2});
  const Filled nothing = fill(1, {9, 9}, {kHole, kHole}, true);
  CHECK(nothing.color == std::vector<int>{0, 0});
  CHECK(nothing.depth == std::vector<float>{0, 0});
}
