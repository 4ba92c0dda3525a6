// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <embree3/rtcore.h>
#include <immintrin.h>

#include "wiw/render/cpu/kernel.hpp"

/// Sixteen lanes: AVX-512 F, DQ, BW, VL.
namespace wiw::render::cpu {
namespace {

constexpr int kLanes = 16;
typedef float Floats __attribute__((vector_size(4 * kLanes)));
typedef std::int32_t Ints __attribute__((vector_size(4 * kLanes)));
using RayHit = RTCRayHit16;
using Rays = RTCRay16;

inline void intersect(const int* valid, RTCScene scene, RTCIntersectContext* context, RayHit* rays) {
  rtcIntersect16(valid, scene, context, rays);
}

inline void occluded(const int* valid, RTCScene scene, RTCIntersectContext* context, Rays* rays) {
  rtcOccluded16(valid, scene, context, rays);
}

inline Floats floor_of(Floats x) {
  return (Floats)_mm512_roundscale_ps((__m512)x, _MM_FROUND_TO_NEG_INF | _MM_FROUND_NO_EXC);
}
inline Floats sqrt_of(Floats x) { return (Floats)_mm512_sqrt_ps((__m512)x); }

inline Floats columns_of(const float* first) { return (Floats)_mm512_broadcast_f32x4(_mm_loadu_ps(first)); }
inline Floats rows_of(const float* first) {
  const __m512 four = _mm512_broadcast_f32x4(_mm_loadu_ps(first));
  return (Floats)_mm512_permutexvar_ps(_mm512_setr_epi32(0, 0, 0, 0, 1, 1, 1, 1, 2, 2, 2, 2, 3, 3, 3, 3), four);
}

inline int mask_bits(Ints mask) { return _mm512_movepi32_mask((__m512i)mask); }

inline Floats look_up(const float* table, Ints index) {
  return (Floats)_mm512_permutexvar_ps((__m512i)index, _mm512_loadu_ps(table));
}
inline Ints look_up(const std::int32_t* table, Ints index) {
  return (Ints)_mm512_permutexvar_epi32((__m512i)index, _mm512_loadu_si512(table));
}

#ifndef WIW_RENDER_GATHER
/// The texel pairs of lanes a and b.
inline __m128i two_pairs(const std::uint32_t* texels, std::int32_t a, std::int32_t b) {
  const __m128i low = _mm_loadl_epi64(reinterpret_cast<const __m128i*>(texels + a));  // pairs lie at any texel
  return _mm_castpd_si128(_mm_loadh_pd(_mm_castsi128_pd(low), reinterpret_cast<const double*>(texels + b)));
}

inline __m512i eight_pairs(const std::uint32_t* texels, const std::int32_t* index) {
  __m512i pairs = _mm512_castsi128_si512(two_pairs(texels, index[0], index[1]));
  pairs = _mm512_inserti64x2(pairs, two_pairs(texels, index[2], index[3]), 1);
  __m256i high = _mm256_castsi128_si256(two_pairs(texels, index[4], index[5]));
  high = _mm256_inserti128_si256(high, two_pairs(texels, index[6], index[7]), 1);
  return _mm512_inserti64x4(pairs, high, 1);
}
#endif

/// Texels `index` and `index + 1` of every lane. Gather instructions are microcode on many processors, where separate
/// loads beat them (wiw::gathers_quickly).
inline void load_pairs(const std::uint32_t* texels, Ints index, Ints& left, Ints& right) {
#ifdef WIW_RENDER_GATHER
  const __m512i low = _mm512_i32gather_epi64(_mm512_castsi512_si256((__m512i)index), texels, 4);
  const __m512i high = _mm512_i32gather_epi64(_mm512_extracti64x4_epi64((__m512i)index, 1), texels, 4);
#else
  alignas(64) std::int32_t indices[kLanes];
  _mm512_store_si512(indices, (__m512i)index);
  const __m512i low = eight_pairs(texels, indices);
  const __m512i high = eight_pairs(texels, indices + 8);
#endif
  const __m512i even = _mm512_setr_epi32(0, 2, 4, 6, 8, 10, 12, 14, 16, 18, 20, 22, 24, 26, 28, 30);
  const __m512i odd = _mm512_setr_epi32(1, 3, 5, 7, 9, 11, 13, 15, 17, 19, 21, 23, 25, 27, 29, 31);
  left = (Ints)_mm512_permutex2var_epi32(low, even, high);
  right = (Ints)_mm512_permutex2var_epi32(low, odd, high);
}

/// words[k] = word k of every lane's 64-byte line: a 16 x 16 transpose in four butterfly steps.
inline void load_lines(const void* lines, const std::uint32_t* index, Floats* words) {
  const auto* base = static_cast<const float*>(lines);
  __m512 rows[16];
  for (int lane = 0; lane < kLanes; ++lane) {
    rows[lane] = _mm512_load_ps(base + std::size_t{index[lane]} * kRecordWords);
  }
  __m512 quads[16];  // quads[4 g + k]: word k of every 4-word block, for the four lanes 4 g ...
  for (int g = 0; g < 4; ++g) {
    const __m512* r = rows + 4 * g;
    const __m512 a = _mm512_unpacklo_ps(r[0], r[1]);
    const __m512 b = _mm512_unpackhi_ps(r[0], r[1]);
    const __m512 c = _mm512_unpacklo_ps(r[2], r[3]);
    const __m512 d = _mm512_unpackhi_ps(r[2], r[3]);
    quads[4 * g + 0] = _mm512_shuffle_ps(a, c, 0x44);
    quads[4 * g + 1] = _mm512_shuffle_ps(a, c, 0xEE);
    quads[4 * g + 2] = _mm512_shuffle_ps(b, d, 0x44);
    quads[4 * g + 3] = _mm512_shuffle_ps(b, d, 0xEE);
  }
  for (int k = 0; k < 4; ++k) {
    const __m512 a = _mm512_shuffle_f32x4(quads[k], quads[4 + k], 0x88);  // blocks 0, 2 of lanes 0-3 and 4-7
    const __m512 b = _mm512_shuffle_f32x4(quads[8 + k], quads[12 + k], 0x88);
    const __m512 c = _mm512_shuffle_f32x4(quads[k], quads[4 + k], 0xDD);  // blocks 1, 3
    const __m512 d = _mm512_shuffle_f32x4(quads[8 + k], quads[12 + k], 0xDD);
    words[k] = (Floats)_mm512_shuffle_f32x4(a, b, 0x88);
    words[8 + k] = (Floats)_mm512_shuffle_f32x4(a, b, 0xDD);
    words[4 + k] = (Floats)_mm512_shuffle_f32x4(c, d, 0x88);
    words[12 + k] = (Floats)_mm512_shuffle_f32x4(c, d, 0xDD);
  }
}

}  // namespace
}  // namespace wiw::render::cpu
