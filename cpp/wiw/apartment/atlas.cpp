// SPDX-License-Identifier: Apache-2.0
#include "wiw/apartment/atlas.hpp"

#include <cmath>
#include <numeric>

namespace wiw::apartment {

Atlas::Atlas(const std::vector<Chart>& charts) : places(charts.size()) {
  constexpr int kWidth = 1024;
  for (std::size_t i = 0; i < charts.size(); ++i) {
    places[i].columns = std::max(2, static_cast<int>(std::lround(charts[i].size.x() / charts[i].texel)));
    places[i].rows = std::max(2, static_cast<int>(std::lround(charts[i].size.y() / charts[i].texel)));
    places[i].first = texels;
    texels += static_cast<std::size_t>(places[i].columns) * static_cast<std::size_t>(places[i].rows);
  }
  std::vector<std::size_t> order(charts.size());
  std::iota(order.begin(), order.end(), std::size_t{0});
  std::stable_sort(order.begin(), order.end(),
                   [&](std::size_t a, std::size_t b) { return places[a].rows > places[b].rows; });
  int x = 0, y = 0, shelf = 0;
  for (const std::size_t i : order) {
    const int w = places[i].columns + 2 * kPadding, h = places[i].rows + 2 * kPadding;
    if (x + w > kWidth) x = 0, y += shelf, shelf = 0;
    places[i].x = x + kPadding, places[i].y = y + kPadding;
    x += w;
    shelf = std::max(shelf, h);
  }
  size = {y + shelf, kWidth};
}

namespace {

Vec2 on_chart(const Chart& chart, const Vec3& position) {
  const Vec3 offset = position - chart.origin;
  return Vec2(offset.dot(chart.u), offset.dot(chart.v)).cwiseQuotient(chart.size);
}

}  // namespace

Vec2 Atlas::uv(const Chart& chart, const ChartPlace& place, const Vec3& position) const {
  const Vec2 p = on_chart(chart, position);
  return {(static_cast<float>(place.x) + p.x() * static_cast<float>(place.columns)) / static_cast<float>(size.width),
          (static_cast<float>(place.y) + p.y() * static_cast<float>(place.rows)) / static_cast<float>(size.height)};
}

std::size_t Atlas::texel_at(const Chart& chart, const ChartPlace& place, const Vec3& position) const {
  const Vec2 p = on_chart(chart, position);
  const int column = std::clamp(static_cast<int>(p.x() * static_cast<float>(place.columns)), 0, place.columns - 1);
  const int row = std::clamp(static_cast<int>(p.y() * static_cast<float>(place.rows)), 0, place.rows - 1);
  return place.first + static_cast<std::size_t>(row * place.columns + column);
}

}  // namespace wiw::apartment
