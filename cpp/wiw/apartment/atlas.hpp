// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <vector>

#include "wiw/apartment/draft.hpp"

namespace wiw::apartment {

/// Place of a chart in the lightmap: texels [x, x + columns) x [y, y + rows), with a border of kPadding copied texels.
struct ChartPlace {
  int x = 0, y = 0, columns = 1, rows = 1;
  std::size_t first = 0;  // of its texels in a list of all texels, row by row
};

/// One lightmap for all charts, packed in shelves.
struct Atlas {
  static constexpr int kPadding = 2;
  Size size;
  std::vector<ChartPlace> places;
  std::size_t texels = 0;

  explicit Atlas(const std::vector<Chart>& charts);
  /// Lightmap coordinate of a point on a chart.
  [[nodiscard]] Vec2 uv(const Chart& chart, const ChartPlace& place, const Vec3& position) const;
  /// Texel of the list nearest to a point on a chart.
  [[nodiscard]] std::size_t texel_at(const Chart& chart, const ChartPlace& place, const Vec3& position) const;
};

}  // namespace wiw::apartment
