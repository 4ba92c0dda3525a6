// SPDX-License-Identifier: Apache-2.0
#include "wiw/reproject/fill.hpp"

#include <algorithm>
#include <cmath>
#include <vector>

#include "wiw/reproject/raster.hpp"

namespace wiw::reproject {

namespace {

// Ends whose depths differ by less than this fraction count as one surface.
constexpr float kSameSurface = 0.1F;

struct Row {
  std::uint8_t* color;
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
void fill_gap(const Row& row, int begin, int end) {
  const int left = row.wrap(begin);
  const int right = row.wrap(end);
  const float left_depth = row.depth[left];
  const float right_depth = row.depth[right];
  for (int column = begin + 1; column < end; ++column) {
    const int at = row.wrap(column);
    const float share = static_cast<float>(column - begin) / static_cast<float>(end - begin);
    const float weight = right_weight(left_depth, right_depth, share);
    row.depth[at] = left_depth + weight * (right_depth - left_depth);
    for (int c = 0; c < 3; ++c) {
      const auto a = static_cast<float>(row.color[3 * left + c]);
      const auto b = static_cast<float>(row.color[3 * right + c]);
      row.color[3 * at + c] = static_cast<std::uint8_t>(a + weight * (b - a) + 0.5F);
    }
  }
}

void copy_pixels(const Row& row, int from, int first, int last) {
  for (int column = first; column <= last; ++column) {
    row.depth[column] = row.depth[from];
    std::copy_n(row.color + 3 * from, 3, row.color + 3 * column);
  }
}

/// Returns false if the row has no depth at all.
bool fill_row(const Row& row, bool wraps) {
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
    copy_pixels(row, first, 0, first - 1);
    copy_pixels(row, last, last + 1, row.width - 1);
  }
  return true;
}

}  // namespace

void fill_holes(ImageView<std::uint8_t> color, ImageView<float> depth, bool wraps) {
  const int height = depth.size.height;
  const int width = depth.size.width;
  std::vector<int> filled;
  for (int y = 0; y < height; ++y) {
    if (fill_row({color.row(y), depth.row(y), width}, wraps)) filled.push_back(y);
  }
  if (filled.empty()) {
    std::fill_n(color.data, 3 * color.size.pixels(), std::uint8_t{0});
    std::fill_n(depth.data, depth.size.pixels(), 0.0F);
    return;
  }
  if (static_cast<int>(filled.size()) == height) return;
  auto next = filled.begin();
  for (int y = 0; y < height; ++y) {
    while (std::next(next) != filled.end() && std::abs(*std::next(next) - y) <= std::abs(*next - y)) ++next;
    if (*next == y) continue;
    std::copy_n(color.row(*next), 3 * width, color.row(y));
    std::copy_n(depth.row(*next), width, depth.row(y));
  }
}

}  // namespace wiw::reproject
