// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <array>
#include <cstdint>
#include <vector>

#include "wiw/panorama/block_groups.hpp"
#include "wiw/panorama/projection.hpp"

namespace wiw::panorama {

/// Four texels of a source image and their weights, for an output pixel whose 2x2 block is not contiguous.
struct IrregularPixel {
  std::uint32_t pixel;
  std::array<std::int32_t, 4> row;
  std::array<std::int32_t, 4> column;
  std::array<float, 4> weight;
  std::array<std::int16_t, 4> weight14;
};

/// Look-up table of a bilinear resampling. A regular output pixel reads the 2x2 block whose upper left texel is
/// `texel`; pixels at poles or cube edges list their four texels one by one. A table may be read with all columns
/// moved by the same amount (modulo the width), so one table serves all yaws that are whole columns.
///
/// Eight bytes a pixel for uint8 images, because reading the table from the outer caches limits the speed.
struct BilinearTable {
  Size source;
  std::vector<std::uint32_t> texel;       // column | row << 16; irregular pixels hold a harmless 0
  std::vector<std::uint32_t> fraction14;  // x | y << 16, each in units of 1 / 16384
  std::vector<float> fraction_x;          // the same for float images
  std::vector<float> fraction_y;
  std::vector<IrregularPixel> irregular;
  std::vector<BlockGroup> groups;  // may be missing: they only make it faster

  [[nodiscard]] std::size_t size() const { return texel.size(); }
};

/// The texel nearest to each output pixel; columns may be moved as in BilinearTable.
struct NearestTable {
  Size source;
  std::vector<std::uint32_t> texel;  // column | row << 16

  [[nodiscard]] std::size_t size() const { return texel.size(); }
};

constexpr int kWeightBits = 14;

constexpr std::uint32_t pack_halves(std::int32_t low, std::int32_t high) {
  return static_cast<std::uint32_t>(low) | (static_cast<std::uint32_t>(high) << 16);
}

/// Rounds weights that add up to 1 to integers that add up to exactly 1 << 14.
std::array<std::int16_t, 4> quantize_weights(const std::array<double, 4>& weights);

/// Appends a pixel that reads the block at (row, column), which must lie inside the source with its neighbours
/// below and to the right (the right one may wrap around).
void append_regular(BilinearTable& table, int row, int column, double fraction_x, double fraction_y);

/// Appends a pixel that reads four given texels.
void append_irregular(BilinearTable& table, const std::array<std::int32_t, 4>& rows,
                      const std::array<std::int32_t, 4>& columns, const std::array<double, 4>& weights);

/// Tables for a panorama. Columns wrap; the row above the first is the first row half a turn away, and likewise
/// below the last. `extra_columns` is added to every x.
BilinearTable bilinear_panorama_table(const Size& panorama, const Coordinates& coordinates, double extra_columns = 0.0);
NearestTable nearest_panorama_table(const Size& panorama, const Coordinates& coordinates, double extra_columns = 0.0);

}  // namespace wiw::panorama
