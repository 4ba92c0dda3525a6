// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <embree3/rtcore.h>
#include <immintrin.h>

#include "wiw/render/cpu/kernel.hpp"

/// Eight lanes: AVX2 with FMA.
namespace wiw::render::cpu {
namespace {

constexpr int kLanes = 8;
typedef float Floats __attribute__((vector_size(4 * kLanes)));
typedef std::int32_t Ints __attribute__((vector_size(4 * kLanes)));
using RayHit = RTCRayHit8;
using Rays = RTCRay8;

inline void intersect(const int* valid, RTCScene scene, RTCIntersectContext* context, RayHit* rays) {
  rtcIntersect8(valid, scene, context, rays);
}

inline void occluded(const int* valid, RTCScene scene, RTCIntersectContext* context, Rays* rays) {
  rtcOccluded8(valid, scene, context, rays);
}

inline Floats floor_of(Floats x) { return (Floats)_mm256_floor_ps((__m256)x); }
inline Floats sqrt_of(Floats x) { return (Floats)_mm256_sqrt_ps((__m256)x); }

inline Floats columns_of(const float* first) {
  return (Floats)_mm256_broadcast_ps(reinterpret_cast<const __m128*>(first));
}
inline Floats rows_of(const float* first) {
  return (Floats)_mm256_set_m128(_mm_set1_ps(first[1]), _mm_set1_ps(first[0]));
}

inline int mask_bits(Ints mask) { return _mm256_movemask_ps((__m256)mask); }

inline Floats look_up(const float* table, Ints index) {
  const __m256 low = _mm256_permutevar8x32_ps(_mm256_loadu_ps(table), (__m256i)index);
  const __m256 high = _mm256_permutevar8x32_ps(_mm256_loadu_ps(table + 8), (__m256i)index);
  return (Floats)_mm256_blendv_ps(low, high, (__m256)(index << 28));
}
inline Ints look_up(const std::int32_t* table, Ints index) {
  return (Ints)look_up(reinterpret_cast<const float*>(table), index);
}

/// The texel pairs of lanes a and b. Separate loads beat gather instructions, which are microcode on many processors.
inline __m128i two_pairs(const std::uint32_t* texels, std::int32_t a, std::int32_t b) {
  const __m128i low = _mm_loadl_epi64(reinterpret_cast<const __m128i*>(texels + a));  // pairs lie at any texel
  return _mm_castpd_si128(_mm_loadh_pd(_mm_castsi128_pd(low), reinterpret_cast<const double*>(texels + b)));
}

/// Texels `index` and `index + 1` of every lane.
inline void load_pairs(const std::uint32_t* texels, Ints index, Ints& left, Ints& right) {
  // Lanes 0 1 4 5 and 2 3 6 7, so that the shuffles within halves put every lane in its place.
  const __m256 a = _mm256_castsi256_ps(
      _mm256_set_m128i(two_pairs(texels, index[4], index[5]), two_pairs(texels, index[0], index[1])));
  const __m256 b = _mm256_castsi256_ps(
      _mm256_set_m128i(two_pairs(texels, index[6], index[7]), two_pairs(texels, index[2], index[3])));
  left = (Ints)_mm256_shuffle_ps(a, b, 0x88);
  right = (Ints)_mm256_shuffle_ps(a, b, 0xDD);
}

/// Transposes eight rows of eight in place.
inline void transpose(__m256 rows[8]) {
  __m256 pairs[8];
  for (int i = 0; i < 4; ++i) {
    pairs[2 * i] = _mm256_unpacklo_ps(rows[2 * i], rows[2 * i + 1]);
    pairs[2 * i + 1] = _mm256_unpackhi_ps(rows[2 * i], rows[2 * i + 1]);
  }
  __m256 quads[8];
  for (int half = 0; half < 2; ++half) {
    const __m256* p = pairs + 4 * half;
    quads[4 * half + 0] = _mm256_shuffle_ps(p[0], p[2], 0x44);
    quads[4 * half + 1] = _mm256_shuffle_ps(p[0], p[2], 0xEE);
    quads[4 * half + 2] = _mm256_shuffle_ps(p[1], p[3], 0x44);
    quads[4 * half + 3] = _mm256_shuffle_ps(p[1], p[3], 0xEE);
  }
  for (int i = 0; i < 4; ++i) {
    rows[i] = _mm256_permute2f128_ps(quads[i], quads[4 + i], 0x20);
    rows[4 + i] = _mm256_permute2f128_ps(quads[i], quads[4 + i], 0x31);
  }
}

/// words[k] = word k of every lane's 64-byte line.
inline void load_lines(const void* lines, const std::uint32_t* index, Floats* words) {
  const auto* base = static_cast<const float*>(lines);
  for (int half = 0; half < 2; ++half) {
    __m256 rows[8];
    for (int lane = 0; lane < kLanes; ++lane) {
      rows[lane] = _mm256_load_ps(base + std::size_t{index[lane]} * kRecordWords + 8 * half);
    }
    transpose(rows);
    for (int k = 0; k < 8; ++k) words[8 * half + k] = (Floats)rows[k];
  }
}

}  // namespace
}  // namespace wiw::render::cpu
