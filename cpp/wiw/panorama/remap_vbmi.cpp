// SPDX-License-Identifier: Apache-2.0
#include <immintrin.h>

#include "wiw/panorama/remap_kernel.hpp"

namespace wiw::panorama {

namespace {

/// The bytes of left and right texel in an int32 lane: both are zero-extended to int16.
constexpr __mmask64 kBytes = 0x5555555555555555ULL;

struct alignas(64) ByteOrder {
  std::uint8_t at[64];
};

/// Each of sixteen bytes four times.
constexpr ByteOrder kFourTimes = [] {
  ByteOrder order{};
  for (int i = 0; i < 64; ++i) order.at[i] = static_cast<std::uint8_t>(i / 4);
  return order;
}();

/// The lower three bytes of each int32 lane, side by side.
constexpr ByteOrder kFirstThree = [] {
  ByteOrder order{};
  for (int i = 0; i < 48; ++i) order.at[i] = static_cast<std::uint8_t>(i / 3 * 4 + i % 3);
  return order;
}();

/// Sixteen pixels, one an int32 lane, for all three channels: weights [00 | 01 << 16] and [10 | 11 << 16], and in
/// each byte the place of its block (BlockGroup) in the rows loaded.
struct Plan {
  __m512i top, bottom, place;
  __mmask64 lower;  // bytes of blocks in the third and fourth row
};

inline Plan make_plan(const BlockGroup& group, const std::uint32_t* fraction14) {
  const __m512i fraction = _mm512_loadu_si512(fraction14);
  const __m512i fx = _mm512_and_si512(fraction, _mm512_set1_epi32(0xFFFF));
  const __m512i fy = _mm512_srli_epi32(fraction, 16);
  const __m512i w11 = _mm512_srli_epi32(_mm512_add_epi32(_mm512_madd_epi16(fx, fy), _mm512_set1_epi32(1 << 13)), 14);
  const __m512i w01 = _mm512_sub_epi32(fx, w11);
  const __m512i w10 = _mm512_sub_epi32(fy, w11);
  const __m512i w00 = _mm512_sub_epi32(_mm512_sub_epi32(_mm512_set1_epi32(1 << 14), fx), w10);
  const __m128i places = _mm_loadu_si128(reinterpret_cast<const __m128i*>(group.place));
  const __m512i place = _mm512_permutexvar_epi8(_mm512_load_si512(kFourTimes.at), _mm512_castsi128_si512(places));
  return {_mm512_or_si512(w00, _mm512_slli_epi32(w01, 16)), _mm512_or_si512(w10, _mm512_slli_epi32(w11, 16)), place,
          _mm512_test_epi8_mask(place, _mm512_set1_epi8(-128)) & kBytes};
}

/// Where a channel's left and right texel lie.
template <int kChannel>
inline __m512i channel_bytes(const Plan& plan) {
  return _mm512_add_epi8(plan.place, _mm512_set1_epi32(kChannel | (3 + kChannel) << 16));
}

/// 32 bytes for each half of the group.
inline __m512i load_row(const std::uint8_t* a, const std::uint8_t* b) {
  return _mm512_inserti64x4(_mm512_castsi256_si512(_mm256_loadu_si256(reinterpret_cast<const __m256i*>(a))),
                            _mm256_loadu_si256(reinterpret_cast<const __m256i*>(b)), 1);
}

inline __m512i mix(__m512i upper, __m512i lower, const Plan& plan) {
  const __m512i half = _mm512_set1_epi32(1 << 13);
  const __m512i sum = _mm512_dpwssd_epi32(_mm512_dpwssd_epi32(half, upper, plan.top), lower, plan.bottom);
  return _mm512_srli_epi32(sum, 14);
}

/// Blocks that begin in the first of two rows.
struct OneRow {
  __m512i r0, r1;
  OneRow(const std::uint8_t* a, const std::uint8_t* b, std::ptrdiff_t row_bytes)
      : r0(load_row(a, b)), r1(load_row(a + row_bytes, b + row_bytes)) {}
  [[nodiscard]] __m512i blend(__m512i bytes, const Plan& plan) const {
    return mix(_mm512_maskz_permutexvar_epi8(kBytes, bytes, r0), _mm512_maskz_permutexvar_epi8(kBytes, bytes, r1),
               plan);
  }
};

/// Blocks that begin in the first two of three rows.
struct TwoRows {
  __m512i r0, r1, r2;
  TwoRows(const std::uint8_t* a, const std::uint8_t* b, std::ptrdiff_t row_bytes)
      : r0(load_row(a, b)),
        r1(load_row(a + row_bytes, b + row_bytes)),
        r2(load_row(a + 2 * row_bytes, b + 2 * row_bytes)) {}
  [[nodiscard]] __m512i blend(__m512i bytes, const Plan& plan) const {
    return mix(_mm512_maskz_permutex2var_epi8(kBytes, r0, bytes, r1),
               _mm512_maskz_permutex2var_epi8(kBytes, r1, bytes, r2), plan);
  }
};

/// Blocks that begin in the first three of four rows.
struct ThreeRows {
  TwoRows upper;
  __m512i r3;
  ThreeRows(const std::uint8_t* a, const std::uint8_t* b, std::ptrdiff_t row_bytes)
      : upper(a, b, row_bytes), r3(load_row(a + 3 * row_bytes, b + 3 * row_bytes)) {}
  [[nodiscard]] __m512i blend(__m512i bytes, const Plan& plan) const {
    const __m512i top = _mm512_maskz_permutex2var_epi8(kBytes, upper.r0, bytes, upper.r1);
    const __m512i bottom = _mm512_maskz_permutex2var_epi8(kBytes, upper.r1, bytes, upper.r2);
    return mix(_mm512_mask_permutexvar_epi8(top, plan.lower, bytes, upper.r2),
               _mm512_mask_permutexvar_epi8(bottom, plan.lower, bytes, r3), plan);
  }
};

/// Blocks that begin in the first four of five rows.
struct FourRows {
  TwoRows upper;
  __m512i r3, r4;
  FourRows(const std::uint8_t* a, const std::uint8_t* b, std::ptrdiff_t row_bytes)
      : upper(a, b, row_bytes),
        r3(load_row(a + 3 * row_bytes, b + 3 * row_bytes)),
        r4(load_row(a + 4 * row_bytes, b + 4 * row_bytes)) {}
  [[nodiscard]] __m512i blend(__m512i bytes, const Plan& plan) const {
    const __mmask64 first = kBytes & ~plan.lower;
    return mix(_mm512_or_si512(_mm512_maskz_permutex2var_epi8(first, upper.r0, bytes, upper.r1),
                               _mm512_maskz_permutex2var_epi8(plan.lower, upper.r2, bytes, r3)),
               _mm512_or_si512(_mm512_maskz_permutex2var_epi8(first, upper.r1, bytes, upper.r2),
                               _mm512_maskz_permutex2var_epi8(plan.lower, r3, bytes, r4)),
               plan);
  }
};

/// Writes sixteen pixels from an int32 lane each in three channels.
inline void store(std::uint8_t* out, __m512i red, __m512i green, __m512i blue) {
  const __m512i texels =
      _mm512_or_si512(_mm512_or_si512(red, _mm512_slli_epi32(green, 8)), _mm512_slli_epi32(blue, 16));
  _mm512_mask_storeu_epi32(out, 0x0FFF, _mm512_permutexvar_epi8(_mm512_load_si512(kFirstThree.at), texels));
}

inline void remap_blocks_one_by_one(const GroupRun& run, const RemapStream& stream, std::size_t i) {
  remap_run_avx512(
      {stream.source, run.source_width, stream.shift, run.texel + i, run.fraction14 + i, stream.out + 3 * i, kGroup});
}

template <class Rows>
inline void remap_group(const GroupRun& run, const BlockGroup& group, std::size_t i) {
  const Plan plan = make_plan(group, run.fraction14 + i);
  const __m512i red = channel_bytes<0>(plan), green = channel_bytes<1>(plan), blue = channel_bytes<2>(plan);
  const std::ptrdiff_t row_bytes = 3 * static_cast<std::ptrdiff_t>(run.source_width);
  const std::ptrdiff_t a = group.row[0] * row_bytes + 3 * static_cast<std::ptrdiff_t>(group.column[0]);
  const std::ptrdiff_t b = group.row[1] * row_bytes + 3 * static_cast<std::ptrdiff_t>(group.column[1]);
  const std::ptrdiff_t ahead = kPrefetchGroupRows * row_bytes;
  for (std::size_t s = 0; s < run.stream_count; ++s) {
    const RemapStream& stream = run.streams[s];
    const int shift = stream.shift - (group.first + stream.shift >= run.source_width ? run.source_width : 0);
    if (group.last + shift >= run.source_width - 1) {  // blocks on both sides of the seam, or across it
      remap_blocks_one_by_one(run, stream, i);
      continue;
    }
    const std::uint8_t* source = stream.source + 3 * static_cast<std::ptrdiff_t>(shift);
    _mm_prefetch(source + a + ahead, _MM_HINT_T0);
    _mm_prefetch(source + b + ahead, _MM_HINT_T0);
    const Rows rows(source + a, source + b, row_bytes);
    store(stream.out + 3 * i, rows.blend(red, plan), rows.blend(green, plan), rows.blend(blue, plan));
  }
}

}  // namespace

void remap_groups_vbmi(const GroupRun& run) {
  for (std::size_t g = 0; g < run.group_count; ++g) {
    const BlockGroup& group = run.groups[g];
    if (group.rows == 0) {
      for (std::size_t s = 0; s < run.stream_count; ++s) remap_blocks_one_by_one(run, run.streams[s], g * kGroup);
    } else if (group.rows == 1) {
      remap_group<OneRow>(run, group, g * kGroup);
    } else if (group.rows == 2) {
      remap_group<TwoRows>(run, group, g * kGroup);
    } else if (group.rows == 3) {
      remap_group<ThreeRows>(run, group, g * kGroup);
    } else {
      remap_group<FourRows>(run, group, g * kGroup);
    }
  }
}

}  // namespace wiw::panorama
