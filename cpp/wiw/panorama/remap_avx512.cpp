// SPDX-License-Identifier: Apache-2.0
#include <immintrin.h>

#include "wiw/panorama/remap_kernel.hpp"

namespace wiw::panorama {

namespace {

/// As in the AVX2 kernel: int16 pairs (left texel, right texel) of the three channels, per 128-bit lane.
inline __m512i pair_shuffle(char first) {
  const auto at = [first](int byte) { return static_cast<char>(first + byte); };
  return _mm512_broadcast_i32x4(_mm_setr_epi8(at(0), -128, at(3), -128, at(1), -128, at(4), -128, at(2), -128, at(5),
                                              -128, -128, -128, -128, -128));
}

inline __m128i load_block(const std::uint8_t* top, std::ptrdiff_t row_bytes) {
  const __m128i upper = _mm_loadl_epi64(reinterpret_cast<const __m128i*>(top));
  return _mm_castpd_si128(_mm_loadh_pd(_mm_castsi128_pd(upper), reinterpret_cast<const double*>(top + row_bytes - 2)));
}

/// As in the AVX2 kernel: [00 | 01 << 16] and [10 | 11 << 16] of sixteen pixels.
struct Weights {
  __m512i top, bottom;
};

inline Weights block_weights(__m512i fraction) {
  const __m512i fx = _mm512_and_si512(fraction, _mm512_set1_epi32(0xFFFF));
  const __m512i fy = _mm512_srli_epi32(fraction, 16);
  const __m512i w11 = _mm512_srli_epi32(_mm512_add_epi32(_mm512_madd_epi16(fx, fy), _mm512_set1_epi32(1 << 13)), 14);
  const __m512i w01 = _mm512_sub_epi32(fx, w11);
  const __m512i w10 = _mm512_sub_epi32(fy, w11);
  const __m512i w00 = _mm512_sub_epi32(_mm512_sub_epi32(_mm512_set1_epi32(1 << 14), fx), w10);
  return {_mm512_or_si512(w00, _mm512_slli_epi32(w01, 16)), _mm512_or_si512(w10, _mm512_slli_epi32(w11, 16))};
}

template <int kPixel>
inline __m512i blend_four(const RemapRun& run, const std::int32_t* bytes, const Weights& weights, __m512i top_shuffle,
                          __m512i bottom_shuffle) {
  const std::ptrdiff_t row_bytes = 3 * static_cast<std::ptrdiff_t>(run.source_width);
  const __m256i low = _mm256_inserti128_si256(_mm256_castsi128_si256(load_block(run.source + bytes[kPixel], row_bytes)),
                                              load_block(run.source + bytes[kPixel + 4], row_bytes), 1);
  const __m256i high =
      _mm256_inserti128_si256(_mm256_castsi128_si256(load_block(run.source + bytes[kPixel + 8], row_bytes)),
                              load_block(run.source + bytes[kPixel + 12], row_bytes), 1);
  const __m512i block = _mm512_inserti64x4(_mm512_castsi256_si512(low), high, 1);
  constexpr auto kBroadcast = static_cast<_MM_PERM_ENUM>(kPixel * 0x55);
  const __m512i top =
      _mm512_madd_epi16(_mm512_shuffle_epi8(block, top_shuffle), _mm512_shuffle_epi32(weights.top, kBroadcast));
  const __m512i bottom =
      _mm512_madd_epi16(_mm512_shuffle_epi8(block, bottom_shuffle), _mm512_shuffle_epi32(weights.bottom, kBroadcast));
  const __m512i sum = _mm512_add_epi32(_mm512_add_epi32(top, bottom), _mm512_set1_epi32(1 << 13));
  return _mm512_srli_epi32(sum, 14);
}

}  // namespace

void remap_run_avx512(const RemapRun& run) {
  const __m512i shift = _mm512_set1_epi32(run.shift);
  const __m512i low_half = _mm512_set1_epi32(0xFFFF);
  const __m512i row_stride = _mm512_set1_epi32(1 | (run.source_width << 16));
  const __m512i width = _mm512_set1_epi32(run.source_width);
  const __m512i last = _mm512_set1_epi32(run.source_width - 1);
  const __m512i top_shuffle = pair_shuffle(0);
  const __m512i bottom_shuffle = pair_shuffle(10);
  const __m512i pack_shuffle =
      _mm512_broadcast_i32x4(_mm_setr_epi8(0, 1, 2, 4, 5, 6, 8, 9, 10, 12, 13, 14, -128, -128, -128, -128));
  const __m512i join_lanes = _mm512_setr_epi32(0, 1, 2, 4, 5, 6, 8, 9, 10, 12, 13, 14, 0, 0, 0, 0);
  const std::ptrdiff_t ahead = kPrefetchRows * 3 * static_cast<std::ptrdiff_t>(run.source_width);
  std::size_t i = 0;
  for (; i + 16 <= run.count; i += 16) {
    const __m512i texel = _mm512_loadu_si512(run.texel + i);
    __m512i column = _mm512_add_epi32(_mm512_and_si512(texel, low_half), shift);
    const __mmask16 beyond = _mm512_cmpgt_epi32_mask(column, last);
    column = _mm512_mask_sub_epi32(column, beyond, column, width);
    if (_mm512_cmpeq_epi32_mask(column, last) != 0) {  // a block straddles the seam
      remap_pixels_scalar(run, i, i + 16);
      continue;
    }
    __m512i offset = _mm512_add_epi32(_mm512_madd_epi16(texel, row_stride), shift);  // row * width + column
    offset = _mm512_mask_sub_epi32(offset, beyond, offset, width);
    alignas(64) std::int32_t bytes[16];
    _mm512_store_si512(bytes, _mm512_add_epi32(offset, _mm512_slli_epi32(offset, 1)));
    _mm_prefetch(run.source + bytes[0] + ahead, _MM_HINT_T0);
    _mm_prefetch(run.source + bytes[8] + ahead, _MM_HINT_T0);
    const Weights weights = block_weights(_mm512_loadu_si512(run.fraction14 + i));
    const __m512i p0 = blend_four<0>(run, bytes, weights, top_shuffle, bottom_shuffle);
    const __m512i p1 = blend_four<1>(run, bytes, weights, top_shuffle, bottom_shuffle);
    const __m512i p2 = blend_four<2>(run, bytes, weights, top_shuffle, bottom_shuffle);
    const __m512i p3 = blend_four<3>(run, bytes, weights, top_shuffle, bottom_shuffle);
    const __m512i texels = _mm512_packus_epi16(_mm512_packus_epi32(p0, p1), _mm512_packus_epi32(p2, p3));
    const __m512i packed = _mm512_permutexvar_epi32(join_lanes, _mm512_shuffle_epi8(texels, pack_shuffle));
    _mm512_mask_storeu_epi32(run.out + 3 * i, 0x0FFF, packed);
  }
  remap_pixels_scalar(run, i, run.count);
}

}  // namespace wiw::panorama
