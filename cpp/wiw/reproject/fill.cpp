// SPDX-License-Identifier: Apache-2.0
#include "wiw/reproject/fill.hpp"

#include <algorithm>
#include <cmath>
#include <vector>

#include "wiw/reproject/fill_color.hpp"
#include "wiw/reproject/raster.hpp"

namespace wiw::reproject {

namespace {

// Ends whose depths differ by less than this fraction count as one surface.
constexpr float kSameSurface = 0.1F;

struct DepthRow {
  float* depth;
  int width;
  [[nodiscard]] int wrap(int column) const { return ((column % width) + width) % width; }
};

/// Weight of the right-hand end at a gap's pixel, `share` of the way from left to right.
float right_weight(float left_depth, float right_depth, float share) {
  const float farther = std::max(left_depth, right_depth);
  if (std::abs(left_depth - right_depth) <= kSameSurface * farther) return share;
  return right_depth > left_depth ? 1.0F : 0.0F;
}

/// Fills columns (begin, end) exclusive, which may lie beyond the width if the row wraps.
void fill_gap(const DepthRow& row, int begin, int end) {
  const float left_depth = row.depth[row.wrap(begin)];
  const float right_depth = row.depth[row.wrap(end)];
  for (int column = begin + 1; column < end; ++column) {
    const float share = static_cast<float>(column - begin) / static_cast<float>(end - begin);
    const float weight = right_weight(left_depth, right_depth, share);
    row.depth[row.wrap(column)] = left_depth + weight * (right_depth - left_depth);
  }
}

/// Returns false if the row has no depth at all.
bool fill_row(const DepthRow& row, bool wraps) {
  int first = 0;
  while (first < row.width && row.depth[first] == kNothing) ++first;
  if (first == row.width) return false;
  int last = first;
  for (int column = first + 1; column < row.width; ++column) {
    if (row.depth[column] == kNothing) continue;
    if (column > last + 1) fill_gap(row, last, column);
    last = column;
  }
  if (wraps) {
    if (first + row.width > last + 1) fill_gap(row, last, first + row.width);
  } else {
    std::fill_n(row.depth, first, row.depth[first]);
    std::fill(row.depth + last + 1, row.depth + row.width, row.depth[last]);
  }
  return true;
}

void fill_depth(ImageView<float> depth, bool wraps) {
  const int height = depth.size.height;
  const int width = depth.size.width;
  std::vector<int> filled;
  for (int y = 0; y < height; ++y) {
    if (fill_row({depth.row(y), width}, wraps)) filled.push_back(y);
  }
  if (static_cast<int>(filled.size()) == height) return;
  auto next = filled.begin();
  for (int y = 0; y < height; ++y) {
    while (std::next(next) != filled.end() && std::abs(*std::next(next) - y) <= std::abs(*next - y)) ++next;
    if (*next != y) std::copy_n(depth.row(*next), width, depth.row(y));
  }
}

}  // namespace

void fill_holes(ImageView<std::uint8_t> color, ImageView<float> depth, bool wraps) {
  const std::size_t pixels = depth.size.pixels();
  const auto holes = static_cast<std::size_t>(std::count(depth.data, depth.data + pixels, kNothing));
  if (holes == 0) return;
  if (holes == pixels) {
    std::fill_n(color.data, 3 * pixels, std::uint8_t{0});
    std::fill_n(depth.data, pixels, 0.0F);
    return;
  }
  fill_color(color, depth, wraps);
  fill_depth(depth, wraps);
}

}  // namespace wiw::reproject
