// SPDX-License-Identifier: Apache-2.0
#include <immintrin.h>

#include "wiw/panorama/remap_kernel.hpp"

namespace wiw::panorama {

namespace {

/// Bytes of the three channels of a lane's pixel, left and right texel in turn, zero-extended to int16: bits of the
/// bytes that are read.
constexpr __mmask64 kBytes = 0x0555055505550555ULL;

/// Weights [00 | 01 << 16] and [10 | 11 << 16] of sixteen pixels, and for each the place of its block in the rows
/// loaded: 64 times the row, plus the byte in it.
struct Plan {
  __m512i top, bottom, place;
};

/// v[0] in the lower and v[1] in the upper half of the int32 lanes.
inline __m512i halves(const std::uint16_t* v) {
  return _mm512_inserti64x4(_mm512_set1_epi32(v[0]), _mm256_set1_epi32(v[1]), 1);
}

inline Plan make_plan(const BlockGroup& group, const std::uint32_t* texel, const std::uint32_t* fraction14) {
  const __m512i fraction = _mm512_loadu_si512(fraction14);
  const __m512i fx = _mm512_and_si512(fraction, _mm512_set1_epi32(0xFFFF));
  const __m512i fy = _mm512_srli_epi32(fraction, 16);
  const __m512i w11 = _mm512_srli_epi32(_mm512_add_epi32(_mm512_madd_epi16(fx, fy), _mm512_set1_epi32(1 << 13)), 14);
  const __m512i w01 = _mm512_sub_epi32(fx, w11);
  const __m512i w10 = _mm512_sub_epi32(fy, w11);
  const __m512i w00 = _mm512_sub_epi32(_mm512_sub_epi32(_mm512_set1_epi32(1 << 14), fx), w10);
  const __m512i block = _mm512_loadu_si512(texel);
  const __m512i column = _mm512_sub_epi32(_mm512_and_si512(block, _mm512_set1_epi32(0xFFFF)), halves(group.column));
  const __m512i row = _mm512_sub_epi32(_mm512_srli_epi32(block, 16), halves(group.row));
  const __m512i upper_half = _mm512_inserti64x4(_mm512_setzero_si512(), _mm256_set1_epi32(32), 1);
  const __m512i byte = _mm512_add_epi32(_mm512_add_epi32(column, _mm512_slli_epi32(column, 1)), upper_half);
  return {_mm512_or_si512(w00, _mm512_slli_epi32(w01, 16)), _mm512_or_si512(w10, _mm512_slli_epi32(w11, 16)),
          _mm512_add_epi32(byte, _mm512_slli_epi32(row, 6))};
}

/// One pixel of each 128-bit lane: its weights in all channels and the bytes of its block.
struct Pixels {
  __m512i top, bottom, bytes;
  __mmask64 lower;  // those in the third and fourth row of blocks
};

template <int kPixel>
inline Pixels pixels_of(const Plan& plan) {
  constexpr auto kBroadcast = static_cast<_MM_PERM_ENUM>(kPixel * 0x55);
  const __m512i pattern = _mm512_broadcast_i32x4(_mm_setr_epi8(0, 0, 3, 0, 1, 0, 4, 0, 2, 0, 5, 0, 0, 0, 0, 0));
  const __m512i bytes =
      _mm512_add_epi8(_mm512_shuffle_epi8(plan.place, _mm512_set1_epi8(static_cast<char>(4 * kPixel))), pattern);
  return {_mm512_shuffle_epi32(plan.top, kBroadcast), _mm512_shuffle_epi32(plan.bottom, kBroadcast), bytes,
          _mm512_test_epi8_mask(bytes, _mm512_set1_epi8(-128)) & kBytes};
}

/// 32 bytes for each half of the group.
inline __m512i load_row(const std::uint8_t* a, const std::uint8_t* b) {
  return _mm512_inserti64x4(_mm512_castsi256_si512(_mm256_loadu_si256(reinterpret_cast<const __m256i*>(a))),
                            _mm256_loadu_si256(reinterpret_cast<const __m256i*>(b)), 1);
}

inline __m512i mix(__m512i upper, __m512i lower, const Pixels& pixels) {
  const __m512i half = _mm512_set1_epi32(1 << 13);
  const __m512i sum = _mm512_dpwssd_epi32(_mm512_dpwssd_epi32(half, upper, pixels.top), lower, pixels.bottom);
  return _mm512_srli_epi32(sum, 14);
}

/// Blocks that begin in the first two of three rows.
struct TwoRows {
  __m512i r0, r1, r2;
  TwoRows(const std::uint8_t* a, const std::uint8_t* b, std::ptrdiff_t row_bytes)
      : r0(load_row(a, b)),
        r1(load_row(a + row_bytes, b + row_bytes)),
        r2(load_row(a + 2 * row_bytes, b + 2 * row_bytes)) {}
  [[nodiscard]] __m512i blend(const Pixels& p) const {
    return mix(_mm512_maskz_permutex2var_epi8(kBytes, r0, p.bytes, r1),
               _mm512_maskz_permutex2var_epi8(kBytes, r1, p.bytes, r2), p);
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
  [[nodiscard]] __m512i blend(const Pixels& p) const {
    const __mmask64 first = kBytes & ~p.lower;
    return mix(_mm512_or_si512(_mm512_maskz_permutex2var_epi8(first, upper.r0, p.bytes, upper.r1),
                               _mm512_maskz_permutex2var_epi8(p.lower, upper.r2, p.bytes, r3)),
               _mm512_or_si512(_mm512_maskz_permutex2var_epi8(first, upper.r1, p.bytes, upper.r2),
                               _mm512_maskz_permutex2var_epi8(p.lower, r3, p.bytes, r4)),
               p);
  }
};

inline void store(std::uint8_t* out, __m512i p0, __m512i p1, __m512i p2, __m512i p3) {
  const __m512i pack_shuffle =
      _mm512_broadcast_i32x4(_mm_setr_epi8(0, 1, 2, 4, 5, 6, 8, 9, 10, 12, 13, 14, -128, -128, -128, -128));
  const __m512i join_lanes = _mm512_setr_epi32(0, 1, 2, 4, 5, 6, 8, 9, 10, 12, 13, 14, 0, 0, 0, 0);
  const __m512i texels = _mm512_packus_epi16(_mm512_packus_epi32(p0, p1), _mm512_packus_epi32(p2, p3));
  const __m512i packed = _mm512_permutexvar_epi32(join_lanes, _mm512_shuffle_epi8(texels, pack_shuffle));
  _mm512_mask_storeu_epi32(out, 0x0FFF, packed);
}

inline void remap_blocks_one_by_one(const GroupRun& run, const RemapStream& stream, std::size_t i) {
  remap_run_avx512(
      {stream.source, run.source_width, stream.shift, run.texel + i, run.fraction14 + i, stream.out + 3 * i, kGroup});
}

template <class Rows>
inline void remap_group(const GroupRun& run, const BlockGroup& group, std::size_t i) {
  const Plan plan = make_plan(group, run.texel + i, run.fraction14 + i);
  const Pixels p0 = pixels_of<0>(plan), p1 = pixels_of<1>(plan), p2 = pixels_of<2>(plan), p3 = pixels_of<3>(plan);
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
    store(stream.out + 3 * i, rows.blend(p0), rows.blend(p1), rows.blend(p2), rows.blend(p3));
  }
}

}  // namespace

void remap_groups_vbmi(const GroupRun& run) {
  for (std::size_t g = 0; g < run.group_count; ++g) {
    const BlockGroup& group = run.groups[g];
    if (group.rows == 0) {
      for (std::size_t s = 0; s < run.stream_count; ++s) remap_blocks_one_by_one(run, run.streams[s], g * kGroup);
    } else if (group.rows <= 2) {
      remap_group<TwoRows>(run, group, g * kGroup);
    } else {
      remap_group<FourRows>(run, group, g * kGroup);
    }
  }
}

}  // namespace wiw::panorama
