// SPDX-License-Identifier: Apache-2.0
#include "wiw/panorama/bilinear_table.hpp"

#include <algorithm>
#include <cmath>

namespace wiw::panorama {

namespace {

int wrap(int column, int width) {
  const int rest = column % width;
  return rest < 0 ? rest + width : rest;
}

std::array<double, 4> bilinear_weights(double fx, double fy) {
  return {(1 - fx) * (1 - fy), fx * (1 - fy), (1 - fx) * fy, fx * fy};
}

/// Pole: the missing row is the edge row seen from the other side of the pole.
void append_polar(BilinearTable& table, int row, int column, double fx, double fy) {
  const int width = table.source.width;
  const int edge = row < 0 ? 0 : table.source.height - 1;
  const int here = wrap(column, width);
  const int right = wrap(column + 1, width);
  const int here_opposite = wrap(column + width / 2, width);
  const int right_opposite = wrap(column + 1 + width / 2, width);
  if (row < 0) {
    append_irregular(table, {edge, edge, edge, edge}, {here_opposite, right_opposite, here, right},
                     bilinear_weights(fx, fy));
  } else {
    append_irregular(table, {edge, edge, edge, edge}, {here, right, here_opposite, right_opposite},
                     bilinear_weights(fx, fy));
  }
}

}  // namespace

std::array<std::int16_t, 4> quantize_weights(const std::array<double, 4>& weights) {
  constexpr int kOne = 1 << kWeightBits;
  std::array<std::int16_t, 4> rounded{};
  int total = 0;
  for (std::size_t i = 0; i < 4; ++i) {
    rounded[i] = static_cast<std::int16_t>(std::lround(weights[i] * kOne));
    total += rounded[i];
  }
  auto& largest = *std::max_element(rounded.begin(), rounded.end());
  largest = static_cast<std::int16_t>(largest + kOne - total);
  return rounded;
}

void append_regular(BilinearTable& table, int row, int column, double fraction_x, double fraction_y) {
  constexpr double kOne = 1 << kWeightBits;
  table.texel.push_back(pack_halves(column, row));
  table.fraction14.push_back(pack_halves(static_cast<std::int32_t>(std::lround(fraction_x * kOne)),
                                         static_cast<std::int32_t>(std::lround(fraction_y * kOne))));
  table.fraction_x.push_back(static_cast<float>(fraction_x));
  table.fraction_y.push_back(static_cast<float>(fraction_y));
}

void append_irregular(BilinearTable& table, const std::array<std::int32_t, 4>& rows,
                      const std::array<std::int32_t, 4>& columns, const std::array<double, 4>& weights) {
  IrregularPixel pixel{static_cast<std::uint32_t>(table.size()), rows, columns, {}, quantize_weights(weights)};
  std::transform(weights.begin(), weights.end(), pixel.weight.begin(), [](double w) { return static_cast<float>(w); });
  table.irregular.push_back(pixel);
  append_regular(table, 0, 0, 0.0, 0.0);
}

BilinearTable bilinear_panorama_table(const Size& panorama, const Coordinates& coordinates, double extra_columns) {
  BilinearTable table;
  table.source = panorama;
  for (std::size_t i = 0; i < coordinates.x.size(); ++i) {
    const double x = coordinates.x[i] + extra_columns;
    const double y = coordinates.y[i];
    const double floor_x = std::floor(x);
    const double floor_y = std::floor(y);
    const int column = static_cast<int>(floor_x);
    const int row = static_cast<int>(floor_y);
    if (row < 0 || row >= panorama.height - 1) {
      append_polar(table, row, column, x - floor_x, y - floor_y);
    } else {
      append_regular(table, row, wrap(column, panorama.width), x - floor_x, y - floor_y);
    }
  }
  table.groups = find_groups(table.texel, panorama);
  return table;
}

NearestTable nearest_panorama_table(const Size& panorama, const Coordinates& coordinates, double extra_columns) {
  NearestTable table;
  table.source = panorama;
  for (std::size_t i = 0; i < coordinates.x.size(); ++i) {
    const int column = wrap(static_cast<int>(std::floor(coordinates.x[i] + extra_columns + 0.5)), panorama.width);
    const int row = std::clamp(static_cast<int>(std::floor(coordinates.y[i] + 0.5)), 0, panorama.height - 1);
    table.texel.push_back(pack_halves(column, row));
  }
  return table;
}

}  // namespace wiw::panorama
