// SPDX-License-Identifier: Apache-2.0
#include "wiw/panorama/block_groups.hpp"

#include <algorithm>

namespace wiw::panorama {

namespace {

constexpr std::int64_t kLoad = 32;  // bytes of a row that are read for half a group
constexpr int kMostColumns = 8;     // from the first to the last block: texel 9 ends at byte 30

struct Bounds {
  int least = 0xFFFF, greatest = 0;
  void add(int value) {
    least = std::min(least, value);
    greatest = std::max(greatest, value);
  }
};

BlockGroup group_at(const std::uint32_t* texel, const Size& source) {
  BlockGroup group{};
  Bounds all;
  int rows = 0;
  bool fits = true;
  for (std::size_t half = 0; half < 2; ++half) {
    Bounds row;
    Bounds column;
    for (std::size_t i = half * kGroup / 2; i < (half + 1) * kGroup / 2; ++i) {
      row.add(static_cast<int>(texel[i] >> 16));
      column.add(static_cast<int>(texel[i] & 0xFFFFu));
      all.add(static_cast<int>(texel[i] & 0xFFFFu));
    }
    group.row[half] = static_cast<std::uint16_t>(row.least);
    group.column[half] = static_cast<std::uint16_t>(column.least);
    rows = std::max(rows, row.greatest - row.least + 1);
    fits = fits && column.greatest - column.least <= kMostColumns;
  }
  group.first = static_cast<std::uint16_t>(all.least);
  group.last = static_cast<std::uint16_t>(all.greatest);
  // The kernel loads one row more than blocks begin in, wherever the columns are moved to.
  const int last_row = std::max(group.row[0], group.row[1]) + rows;
  const auto row_bytes = std::int64_t{3} * source.width;
  fits = fits && rows <= kMostGroupRows && last_row * row_bytes + row_bytes - 3 + kLoad <= source.height * row_bytes;
  if (!fits) return group;
  group.rows = static_cast<std::uint16_t>(rows);
  for (std::size_t i = 0; i < kGroup; ++i) {
    const std::size_t half = 2 * i / kGroup;
    const std::uint32_t row = (texel[i] >> 16) - group.row[half], column = (texel[i] & 0xFFFFu) - group.column[half];
    group.place[i] = static_cast<std::uint8_t>(64 * row + 32 * half + 3 * column);
  }
  return group;
}

}  // namespace

std::vector<BlockGroup> find_groups(const std::vector<std::uint32_t>& texel, const Size& source) {
  std::vector<BlockGroup> groups;
  for (std::size_t i = 0; i + kGroup <= texel.size(); i += kGroup) groups.push_back(group_at(texel.data() + i, source));
  return groups;
}

}  // namespace wiw::panorama
