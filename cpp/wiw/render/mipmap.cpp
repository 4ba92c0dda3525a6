// SPDX-License-Identifier: Apache-2.0
#include "wiw/render/mipmap.hpp"

#include <algorithm>
#include <cmath>

#include "wiw/render/shading.hpp"

namespace wiw::render {

namespace {

/// Source texels [first, first + 3) and their weights for one output texel along one axis: an output texel covers
/// source / target texels, that is 2 for even sides and between 2 and 3 for odd ones (1 for a side of 1).
struct Taps {
  int first = 0;
  int count = 0;
  float weight[3] = {};
};

std::vector<Taps> axis_taps(int source, int target) {
  std::vector<Taps> all(static_cast<std::size_t>(target));
  for (int i = 0; i < target; ++i) {
    const double scale = static_cast<double>(source) / target;
    const double begin = i * scale;
    const double end = (i + 1) * scale;
    Taps& taps = all[static_cast<std::size_t>(i)];
    taps.first = static_cast<int>(begin);
    for (int k = 0; k < 3 && taps.first + k < source; ++k) {
      const double covered = std::min(end, taps.first + k + 1.0) - std::max(begin, taps.first + static_cast<double>(k));
      if (covered <= 1e-9) break;
      taps.weight[k] = static_cast<float>(covered / scale);
      taps.count = k + 1;
    }
  }
  return all;
}

MipLevel halve(const std::uint8_t* source, Size size) {
  MipLevel level;
  level.size = {std::max(1, size.height / 2), std::max(1, size.width / 2)};
  level.rgba.resize(4 * level.size.pixels());
  const auto rows = axis_taps(size.height, level.size.height);
  const auto columns = axis_taps(size.width, level.size.width);
  std::uint8_t* out = level.rgba.data();
  for (const Taps& row : rows) {
    for (const Taps& column : columns) {
      float sum[4] = {};
      for (int y = 0; y < row.count; ++y) {
        const std::uint8_t* in =
            source + 4 * (static_cast<std::size_t>(row.first + y) * static_cast<std::size_t>(size.width) +
                          static_cast<std::size_t>(column.first));
        for (int x = 0; x < column.count; ++x) {
          for (int c = 0; c < 4; ++c) sum[c] += row.weight[y] * column.weight[x] * static_cast<float>(in[4 * x + c]);
        }
      }
      for (const float value : sum) *out++ = static_cast<std::uint8_t>(std::lround(value));
    }
  }
  return level;
}

}  // namespace

std::vector<MipLevel> build_mips(const scene::Texture& texture) {
  std::vector<MipLevel> levels;
  const std::uint8_t* source = texture.rgba.data();
  Size size = texture.size;
  while ((size.height > 1 || size.width > 1) && static_cast<int>(levels.size()) + 1 < shading::kMaxMipLevels) {
    levels.push_back(halve(source, size));
    source = levels.back().rgba.data();
    size = levels.back().size;
  }
  return levels;
}

}  // namespace wiw::render
