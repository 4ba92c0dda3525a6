// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <span>

#include "wiw/core/cpu.hpp"
#include "wiw/panorama/bilinear_table.hpp"

namespace wiw::panorama {

/// One resampling of a source by a table: columns are moved by `shift` in [0, width), `out` holds the table's pixels.
/// `image` counts images that follow the source in memory, each of its size and channels.
template <class T>
struct RemapTarget {
  int shift = 0;
  T* out = nullptr;
  std::size_t image = 0;
};

/// Resamples images to several targets that share a table, walking them together so that the table is read from memory
/// and decoded once. uint8 is rounded from 14-bit weights, float is blended in float32; results do not depend on
/// the instruction set (uint8).
void remap(const BilinearTable& table, ImageView<const std::uint8_t> source,
           std::span<const RemapTarget<std::uint8_t>> targets, Isa isa = active_isa());
void remap(const BilinearTable& table, ImageView<const float> source, std::span<const RemapTarget<float>> targets);

/// The uint8 three-channel kernel on a table made elsewhere, e.g. anew for every image: `texel` and `fraction14` as in
/// BilinearTable, rows of blocks at most H - 2 (H at least 2). Columns wrap if `texel` names the last one.
void remap_blocks(ImageView<const std::uint8_t> source, std::span<const std::uint32_t> texel,
                  std::span<const std::uint32_t> fraction14, std::uint8_t* out, Isa isa = active_isa());

/// Nearest texels, copied: any type, ids included.
template <class T>
void remap(const NearestTable& table, ImageView<const T> source, std::span<const RemapTarget<T>> targets);

}  // namespace wiw::panorama
