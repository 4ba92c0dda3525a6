// SPDX-License-Identifier: Apache-2.0
#include <immintrin.h>

#include "wiw/panorama/remap_kernel.hpp"

namespace wiw::panorama {

namespace {

/// Bytes c of the left and c + 3 of the right texel side by side as int16, for the three channels of a pixel whose
/// texel pair starts at byte `first` of each 128-bit lane; 0x80 writes zero.
inline __m256i pair_shuffle(char first) {
  const auto at = [first](int byte) { return static_cast<char>(first + byte); };
  return _mm256_broadcastsi128_si256(_mm_setr_epi8(at(0), -128, at(3), -128, at(1), -128, at(4), -128, at(2), -128,
                                                   at(5), -128, -128, -128, -128, -128));
}

/// One lane a pixel: eight bytes from its upper texel pair on, then eight bytes that end with its lower pair. The
/// lower load starts two bytes early, so the last texel of an image is read without passing its end.
inline __m128i load_block(const std::uint8_t* top, std::ptrdiff_t row_bytes) {
  const __m128i upper = _mm_loadl_epi64(reinterpret_cast<const __m128i*>(top));
  return _mm_castpd_si128(_mm_loadh_pd(_mm_castsi128_pd(upper), reinterpret_cast<const double*>(top + row_bytes - 2)));
}

/// Weights of eight pixels as int16 pairs: [00 | 01 << 16] and [10 | 11 << 16].
struct Weights {
  __m256i top, bottom;
};

inline Weights block_weights(__m256i fraction) {
  const __m256i fx = _mm256_and_si256(fraction, _mm256_set1_epi32(0xFFFF));
  const __m256i fy = _mm256_srli_epi32(fraction, 16);
  // Both factors have at most 15 bits, so the 16-bit multiply-add sees (fx, 0) x (fy, 0).
  const __m256i w11 = _mm256_srli_epi32(_mm256_add_epi32(_mm256_madd_epi16(fx, fy), _mm256_set1_epi32(1 << 13)), 14);
  const __m256i w01 = _mm256_sub_epi32(fx, w11);
  const __m256i w10 = _mm256_sub_epi32(fy, w11);
  const __m256i w00 = _mm256_sub_epi32(_mm256_sub_epi32(_mm256_set1_epi32(1 << 14), fx), w10);
  return {_mm256_or_si256(w00, _mm256_slli_epi32(w01, 16)), _mm256_or_si256(w10, _mm256_slli_epi32(w11, 16))};
}

template <int kPair>
inline __m256i blend_two(const RemapRun& run, const std::int32_t* bytes, const Weights& weights, __m256i top_shuffle,
                         __m256i bottom_shuffle) {
  const std::ptrdiff_t row_bytes = 3 * static_cast<std::ptrdiff_t>(run.source_width);
  const __m256i block =
      _mm256_inserti128_si256(_mm256_castsi128_si256(load_block(run.source + bytes[kPair], row_bytes)),
                              load_block(run.source + bytes[kPair + 4], row_bytes), 1);
  constexpr int kBroadcast = kPair * 0x55;
  const __m256i top =
      _mm256_madd_epi16(_mm256_shuffle_epi8(block, top_shuffle), _mm256_shuffle_epi32(weights.top, kBroadcast));
  const __m256i bottom =
      _mm256_madd_epi16(_mm256_shuffle_epi8(block, bottom_shuffle), _mm256_shuffle_epi32(weights.bottom, kBroadcast));
  const __m256i sum = _mm256_add_epi32(_mm256_add_epi32(top, bottom), _mm256_set1_epi32(1 << 13));
  return _mm256_srli_epi32(sum, 14);
}

}  // namespace

void remap_run_avx2(const RemapRun& run) {
  const __m256i shift = _mm256_set1_epi32(run.shift);
  const __m256i low_half = _mm256_set1_epi32(0xFFFF);
  const __m256i row_stride = _mm256_set1_epi32(1 | (run.source_width << 16));
  const __m256i width = _mm256_set1_epi32(run.source_width);
  const __m256i last = _mm256_set1_epi32(run.source_width - 1);
  const __m256i top_shuffle = pair_shuffle(0);
  const __m256i bottom_shuffle = pair_shuffle(10);
  const __m256i pack_shuffle =
      _mm256_broadcastsi128_si256(_mm_setr_epi8(0, 1, 2, 4, 5, 6, 8, 9, 10, 12, 13, 14, -128, -128, -128, -128));
  const std::ptrdiff_t ahead = kPrefetchRows * 3 * static_cast<std::ptrdiff_t>(run.source_width);
  std::size_t i = 0;
  for (; i + 8 <= run.count; i += 8) {
    const __m256i texel = _mm256_loadu_si256(reinterpret_cast<const __m256i*>(run.texel + i));
    __m256i column = _mm256_add_epi32(_mm256_and_si256(texel, low_half), shift);
    const __m256i back = _mm256_and_si256(_mm256_cmpgt_epi32(column, last), width);
    column = _mm256_sub_epi32(column, back);
    if (_mm256_movemask_epi8(_mm256_cmpeq_epi32(column, last)) != 0) {  // a block straddles the seam
      remap_pixels_scalar(run, i, i + 8);
      continue;
    }
    const __m256i offset =
        _mm256_add_epi32(_mm256_madd_epi16(texel, row_stride), _mm256_sub_epi32(shift, back));  // row * width + column
    alignas(32) std::int32_t bytes[8];
    _mm256_store_si256(reinterpret_cast<__m256i*>(bytes), _mm256_add_epi32(offset, _mm256_slli_epi32(offset, 1)));
    _mm_prefetch(run.source + bytes[0] + ahead, _MM_HINT_T0);
    const Weights weights = block_weights(_mm256_loadu_si256(reinterpret_cast<const __m256i*>(run.fraction14 + i)));
    const __m256i p0 = blend_two<0>(run, bytes, weights, top_shuffle, bottom_shuffle);
    const __m256i p1 = blend_two<1>(run, bytes, weights, top_shuffle, bottom_shuffle);
    const __m256i p2 = blend_two<2>(run, bytes, weights, top_shuffle, bottom_shuffle);
    const __m256i p3 = blend_two<3>(run, bytes, weights, top_shuffle, bottom_shuffle);
    const __m256i texels = _mm256_packus_epi16(_mm256_packus_epi32(p0, p1), _mm256_packus_epi32(p2, p3));
    const __m256i packed = _mm256_shuffle_epi8(texels, pack_shuffle);  // twelve bytes a lane
    std::uint8_t* out = run.out + 3 * i;
    const __m128i high = _mm256_extracti128_si256(packed, 1);
    _mm_storeu_si128(reinterpret_cast<__m128i*>(out), _mm256_castsi256_si128(packed));
    _mm_storel_epi64(reinterpret_cast<__m128i*>(out + 12), high);
    _mm_storeu_si32(out + 20, _mm_shuffle_epi32(high, 2));
  }
  remap_pixels_scalar(run, i, run.count);
}

}  // namespace wiw::panorama
