// SPDX-License-Identifier: Apache-2.0
#include "wiw/reproject/fill_color.hpp"

#include <algorithm>
#include <array>
#include <cmath>
#include <vector>

#include "wiw/reproject/raster.hpp"

namespace wiw::reproject {

namespace {

constexpr int kBlock = 4;  // pixels a side
// Weights, fitted to squared error over steps of 1.6 m in apartments of the train split.
constexpr float kFalloff = 0.6F;      // power of the distance
constexpr float kVertical = 1.65F;    // of the directions up and down, against left and right
constexpr float kDiagonal = 0.55F;    // of the four oblique directions, their longer steps included
constexpr float kFarthest = 20.0F;    // metres: sky counts as no farther
constexpr float kAnywhere = 1.0e-6F;  // of the mean beside all holes, for what no direction reaches

/// A colour with its weight, and how many blocks away it was met; weight 0 where nothing was.
struct Met {
  std::array<float, 3> color{};
  float weight = 0.0F;
  int steps = 0;
};

/// The image in blocks.
struct Blocks {
  int rows, columns;
  bool wraps;
  std::vector<Met> mean;  // weight 0: hole
  std::vector<Met> sum;   // of holes: weighted colours so far
  [[nodiscard]] std::size_t at(int row, int column) const {
    return static_cast<std::size_t>(row) * static_cast<std::size_t>(columns) + static_cast<std::size_t>(column);
  }
};

/// Mean of a block's pixels, the farther ones counting more: they are what continues into a hole.
Met block_mean(ImageView<const std::uint8_t> color, ImageView<const float> depth, int row, int column) {
  Met mean;
  float total = 0.0F;
  float far = 0.0F;
  for (int y = row * kBlock; y < std::min((row + 1) * kBlock, depth.size.height); ++y) {
    for (int x = column * kBlock; x < std::min((column + 1) * kBlock, depth.size.width); ++x) {
      if (*depth.at(y, x) == kNothing) continue;
      const float z = std::min(*depth.at(y, x), kFarthest);
      for (std::size_t c = 0; c < 3; ++c) mean.color[c] += z * z * static_cast<float>(color.at(y, x)[c]);
      total += z * z;
      far += z * z * z;
    }
  }
  if (total == 0.0F) return mean;
  for (float& value : mean.color) value /= total;
  mean.weight = std::sqrt(far / total);
  return mean;
}

void add(Met& sum, const std::array<float, 3>& color, float weight) {
  for (std::size_t c = 0; c < 3; ++c) sum.color[c] += weight * color[c];
  sum.weight += weight;
}

/// Which blocks hold a hole or lie beside one: the others' colours are not asked for.
std::vector<std::uint8_t> find_near_holes(ImageView<const float> depth, const Blocks& blocks) {
  std::vector<std::uint8_t> near(blocks.mean.size());
  std::vector<std::uint8_t> broken(static_cast<std::size_t>(blocks.columns) + 1);
  for (int row = 0; row < blocks.rows; ++row) {
    std::fill(broken.begin(), broken.end(), std::uint8_t{0});
    for (int y = row * kBlock; y < std::min((row + 1) * kBlock, depth.size.height); ++y) {
      const float* from = depth.row(y);
      for (int x = 0; x < depth.size.width; ++x) broken[static_cast<std::size_t>(x / kBlock)] |= from[x] == kNothing;
    }
    for (int column = 0; column < blocks.columns; ++column) {
      if (broken[static_cast<std::size_t>(column)] == 0) continue;
      for (int y = std::max(row - 1, 0); y <= std::min(row + 1, blocks.rows - 1); ++y) {
        for (const int x : {column - 1, column, column + 1})
          near[blocks.at(y, (x + blocks.columns) % blocks.columns)] = 1;
      }
    }
  }
  return near;
}

Blocks make_blocks(ImageView<const std::uint8_t> color, ImageView<const float> depth, bool wraps) {
  const auto count = [](int pixels) { return (pixels + kBlock - 1) / kBlock; };
  Blocks blocks{count(depth.size.height), count(depth.size.width), wraps, {}, {}};
  blocks.mean.resize(static_cast<std::size_t>(blocks.rows) * static_cast<std::size_t>(blocks.columns));
  const std::vector<std::uint8_t> near = find_near_holes(depth, blocks);
  Met all;
  for (int row = 0; row < blocks.rows; ++row) {
    for (int column = 0; column < blocks.columns; ++column) {
      Met& mean = blocks.mean[blocks.at(row, column)];
      if (near[blocks.at(row, column)] == 0) {
        mean.weight = 1.0F;
        continue;
      }
      mean = block_mean(color, depth, row, column);
      if (mean.weight > 0.0F) add(all, mean.color, 1.0F);
    }
  }
  if (all.weight > 0.0F) {
    for (float& value : all.color) value *= kAnywhere / all.weight;
  }
  all.weight = kAnywhere;
  blocks.sum.assign(blocks.mean.size(), all);
  return blocks;
}

/// d^-kFalloff for whole d.
std::vector<float> falloff(int count) {
  std::vector<float> table{0.0F};
  for (int d = 1; d <= count; ++d) table.push_back(std::pow(static_cast<float>(d), -kFalloff));
  return table;
}

/// One step into a block: what is met there, from what was met in the block before it.
void step(Blocks& blocks, std::size_t at, float direction, const std::vector<float>& table, Met& met) {
  if (blocks.mean[at].weight > 0.0F) {
    met = blocks.mean[at];
    return;
  }
  if (met.weight == 0.0F) return;
  ++met.steps;
  add(blocks.sum[at], met.color, met.weight * direction * table[static_cast<std::size_t>(met.steps)]);
}

/// Along the rows, towards the right for `by` 1 and the left for -1.
void sweep_rows(Blocks& blocks, int by, const std::vector<float>& table) {
  const int count = blocks.columns;
  for (int row = 0; row < blocks.rows; ++row) {
    const auto at = [&](int i) { return blocks.at(row, by > 0 ? i : count - 1 - i); };
    Met met;
    if (blocks.wraps) {
      int last = count - 1;
      while (last >= 0 && blocks.mean[at(last)].weight == 0.0F) --last;
      if (last < 0) continue;
      met = blocks.mean[at(last)];
      met.steps = count - 1 - last;
    }
    for (int i = 0; i < count; ++i) step(blocks, at(i), 1.0F, table, met);
  }
}

/// From row to row, downwards for `by` 1 and upwards for -1, each time `across` columns to the right.
void sweep_columns(Blocks& blocks, int by, int across, const std::vector<float>& table) {
  const int count = blocks.columns;
  const float direction = across == 0 ? kVertical : kDiagonal;
  std::vector<Met> met(static_cast<std::size_t>(count));
  std::vector<Met> next(static_cast<std::size_t>(count));
  for (int i = 0; i < blocks.rows; ++i) {
    const int row = by > 0 ? i : blocks.rows - 1 - i;
    for (int column = 0; column < count; ++column) {
      const int from = column - across;
      const bool outside = from < 0 || from >= count;
      Met& here = next[static_cast<std::size_t>(column)];
      here = outside && !blocks.wraps ? Met{} : met[static_cast<std::size_t>((from + count) % count)];
      step(blocks, blocks.at(row, column), direction, table, here);
    }
    met.swap(next);
  }
}

/// Colours of all blocks, the holes' too.
std::vector<std::array<float, 3>> block_colors(ImageView<const std::uint8_t> color, ImageView<const float> depth,
                                               bool wraps) {
  Blocks blocks = make_blocks(color, depth, wraps);
  const std::vector<float> table = falloff(std::max(blocks.rows, blocks.columns));
  for (const int by : {1, -1}) {
    sweep_rows(blocks, by, table);
    for (const int across : {-1, 0, 1}) sweep_columns(blocks, by, across, table);
  }
  std::vector<std::array<float, 3>> colors;
  for (std::size_t i = 0; i < blocks.mean.size(); ++i) {
    const Met& met = blocks.mean[i].weight > 0.0F ? blocks.mean[i] : blocks.sum[i];
    const float scale = blocks.mean[i].weight > 0.0F ? 1.0F : 1.0F / met.weight;
    colors.push_back({scale * met.color[0], scale * met.color[1], scale * met.color[2]});
  }
  return colors;
}

/// The two blocks whose centres lie around a pixel's along an axis, and the share of the second.
struct Between {
  int first, second;
  float share;
};

Between between(int pixel, int blocks, bool wraps) {
  const int half_pixels = 2 * pixel + 1 - kBlock;  // from the first block's centre
  const int first = half_pixels < 0 ? -1 : half_pixels / (2 * kBlock);
  const float share = static_cast<float>(half_pixels - 2 * kBlock * first) / (2.0F * kBlock);
  const auto fit = [&](int i) { return wraps ? (i + blocks) % blocks : std::clamp(i, 0, blocks - 1); };
  return {fit(first), fit(first + 1), share};
}

}  // namespace

void fill_color(ImageView<std::uint8_t> color, ImageView<const float> depth, bool wraps) {
  const auto colors = block_colors(color, depth, wraps);
  const int columns = (depth.size.width + kBlock - 1) / kBlock;
  const int rows = (depth.size.height + kBlock - 1) / kBlock;
  std::vector<Between> across;
  across.reserve(static_cast<std::size_t>(std::max(0, depth.size.width)));
  for (int x = 0; x < depth.size.width; ++x) across.push_back(between(x, columns, wraps));
  for (int y = 0; y < depth.size.height; ++y) {
    const Between down = between(y, rows, false);
    const auto* upper = colors.data() + static_cast<std::ptrdiff_t>(down.first) * columns;
    const auto* lower = colors.data() + static_cast<std::ptrdiff_t>(down.second) * columns;
    for (int x = 0; x < depth.size.width; ++x) {
      if (*depth.at(y, x) != kNothing) continue;
      const Between& at = across[static_cast<std::size_t>(x)];
      for (std::size_t c = 0; c < 3; ++c) {
        const float top = upper[at.first][c] + at.share * (upper[at.second][c] - upper[at.first][c]);
        const float bottom = lower[at.first][c] + at.share * (lower[at.second][c] - lower[at.first][c]);
        color.at(y, x)[c] = static_cast<std::uint8_t>(top + down.share * (bottom - top) + 0.5F);
      }
    }
  }
}

}  // namespace wiw::reproject
