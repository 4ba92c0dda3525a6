// SPDX-License-Identifier: Apache-2.0
// Included by one object file per instruction set: everything here has internal linkage, so that no function compiled
// for a newer processor can be picked by the linker for an older one.
#pragma once

#include <cstddef>
#include <cstdint>

#include "wiw/panorama/group.hpp"

namespace wiw::panorama {

/// A run of output pixels of a uint8, three-channel bilinear resampling; members as in BilinearTable. `shift` lies in
/// [0, source_width); the source has at least two rows.
struct RemapRun {
  const std::uint8_t* source;
  std::int32_t source_width;
  std::int32_t shift;
  const std::uint32_t* texel;
  const std::uint32_t* fraction14;
  std::uint8_t* out;
  std::size_t count;
};

/// One image that is read and one that is written by a GroupRun; as in RemapRun.
struct RemapStream {
  const std::uint8_t* source;
  std::int32_t shift;
  std::uint8_t* out;
};

/// The first kGroup * group_count pixels of a table, for several images at once: what a group needs is worked out once
/// for all of them. `groups` as made by find_groups.
struct GroupRun {
  std::int32_t source_width;
  const std::uint32_t* texel;
  const std::uint32_t* fraction14;
  const BlockGroup* groups;
  std::size_t group_count;
  const RemapStream* streams;
  std::size_t stream_count;
};

/// Needs AVX-512 VBMI and VNNI.
void remap_groups_vbmi(const GroupRun& run);

using RemapRunFunction = void (*)(const RemapRun&);
void remap_run_avx2(const RemapRun& run);
void remap_run_avx512(const RemapRun& run);

namespace {

// The curved path of an output row through a panorama defeats the hardware prefetcher, but the next rows follow the
// same path a little lower: fetch that many source rows ahead.
constexpr std::ptrdiff_t kPrefetchRows = 6;
constexpr std::ptrdiff_t kPrefetchGroupRows = 8;

inline void remap_pixels_scalar(const RemapRun& run, std::size_t begin, std::size_t end) {
  for (std::size_t i = begin; i < end; ++i) {
    const auto row = static_cast<std::ptrdiff_t>(run.texel[i] >> 16);
    std::int32_t column = static_cast<std::int32_t>(run.texel[i] & 0xFFFFu) + run.shift;
    if (column >= run.source_width) column -= run.source_width;
    const std::ptrdiff_t step = 3 * (column == run.source_width - 1 ? 1 - run.source_width : 1);
    const std::uint8_t* top = run.source + 3 * (row * run.source_width + column);
    const std::uint8_t* bottom = top + 3 * static_cast<std::ptrdiff_t>(run.source_width);
    const std::uint32_t fx = run.fraction14[i] & 0xFFFFu;
    const std::uint32_t fy = run.fraction14[i] >> 16;
    const std::uint32_t w11 = (fx * fy + (1u << 13)) >> 14;
    const std::uint32_t w01 = fx - w11;
    const std::uint32_t w10 = fy - w11;
    const std::uint32_t w00 = (1u << 14) - fx - w10;
    std::uint8_t* out = run.out + 3 * i;
    for (int c = 0; c < 3; ++c) {
      const std::uint32_t sum =
          w00 * top[c] + w01 * top[c + step] + w10 * bottom[c] + w11 * bottom[c + step] + (1u << 13);
      out[c] = static_cast<std::uint8_t>(sum >> 14);
    }
  }
}

}  // namespace

}  // namespace wiw::panorama
