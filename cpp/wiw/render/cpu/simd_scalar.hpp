// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <embree3/rtcore.h>

#include "wiw/render/cpu/kernel.hpp"

/// Four lanes in the compiler's portable vectors: the processor's baseline, no instruction set assumed.
namespace wiw::render::cpu {
namespace {

constexpr int kLanes = 4;
typedef float Floats __attribute__((vector_size(4 * kLanes)));
typedef std::int32_t Ints __attribute__((vector_size(4 * kLanes)));
using RayHit = RTCRayHit4;
using Rays = RTCRay4;

inline void intersect(const int* valid, RTCScene scene, RTCIntersectContext* context, RayHit* rays) {
  rtcIntersect4(valid, scene, context, rays);
}

inline void occluded(const int* valid, RTCScene scene, RTCIntersectContext* context, Rays* rays) {
  rtcOccluded4(valid, scene, context, rays);
}

inline Floats floor_of(Floats x) {
  const Floats truncated = __builtin_convertvector(__builtin_convertvector(x, Ints), Floats);
  return truncated > x ? truncated - 1.f : truncated;
}

inline Floats sqrt_of(Floats x) {
  for (int lane = 0; lane < kLanes; ++lane) x[lane] = __builtin_sqrtf(x[lane]);
  return x;
}

inline Floats columns_of(const float* first) { return Floats{first[0], first[1], first[2], first[3]}; }
inline Floats rows_of(const float* first) { return Floats{} + first[0]; }

inline int mask_bits(Ints mask) { return (mask[0] & 1) | (mask[1] & 2) | (mask[2] & 4) | (mask[3] & 8); }

inline Floats look_up(const float* table, Ints index) {
  return Floats{table[index[0]], table[index[1]], table[index[2]], table[index[3]]};
}
inline Ints look_up(const std::int32_t* table, Ints index) {
  return Ints{table[index[0]], table[index[1]], table[index[2]], table[index[3]]};
}

/// Texels `index` and `index + 1` of every lane.
inline void load_pairs(const std::uint32_t* texels, Ints index, Ints& left, Ints& right) {
  for (int lane = 0; lane < kLanes; ++lane) {
    const std::uint32_t* pair = texels + index[lane];
    left[lane] = static_cast<std::int32_t>(pair[0]);
    right[lane] = static_cast<std::int32_t>(pair[1]);
  }
}

/// words[k] = word k of every lane's 64-byte line.
inline void load_lines(const void* lines, const std::uint32_t* index, Floats* words) {
  const auto* base = static_cast<const float*>(lines);
  const auto line = [&](int lane) { return base + std::size_t{index[lane]} * kRecordWords; };
  const float *a = line(0), *b = line(1), *c = line(2), *d = line(3);
  for (int k = 0; k < kRecordWords; ++k) words[k] = Floats{a[k], b[k], c[k], d[k]};
}

}  // namespace
}  // namespace wiw::render::cpu
