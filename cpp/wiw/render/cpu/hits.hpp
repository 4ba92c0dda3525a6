// SPDX-License-Identifier: Apache-2.0
#pragma once

/// What shading knows of the hits of one packet. Included after a simd_*.hpp.

#include "wiw/render/cpu/lanes.hpp"
#include "wiw/render/cpu/sample.hpp"

namespace wiw::render::cpu {
namespace {

struct Directions {
  Floats x, y, z;
};

/// One packet's hits: barycentric coordinates, depth, geometric normals (any length) and the triangles' records.
struct Hits {
  const RayHit* rays;
  Floats u, v, t;
  Floats nx, ny, nz;
  Directions d;
  Floats spread;  // squared pixel width at t = 1
  Ints hit;
  Floats record[kRecordWords];
};

inline Floats interpolate(const Hits& hits, Floats at_0, Floats to_1, Floats to_2) {
  return at_0 + hits.u * to_1 + hits.v * to_2;
}

/// Interpolated vertex normals and colours of the triangles that have them; the geometric normal for the rest.
struct Detail {
  Floats nx, ny, nz;
  Floats bulge;
  RgbLanes color;
};

inline Detail load_detail(const KernelScene& scene, const Hits& hits) {
  const Ints number = reinterpret_cast<Ints>(hits.record[15]);
  const Ints has = number != static_cast<std::int32_t>(kNoDetail);
  Floats words[kRecordWords];
  alignas(64) std::uint32_t numbers[kLanes];
  store(numbers, has & number);
  load_lines(scene.details, numbers, words);
  Detail detail;
  const Floats nx = interpolate(hits, words[0], words[3], words[6]);
  const Floats ny = interpolate(hits, words[1], words[4], words[7]);
  const Floats nz = interpolate(hits, words[2], words[5], words[8]);
  const Ints smooth = has & (nx * nx + ny * ny + nz * nz > 1e-12f);
  detail.nx = smooth ? nx : hits.nx;
  detail.ny = smooth ? ny : hits.ny;
  detail.nz = smooth ? nz : hits.nz;
  detail.bulge = smooth ? words[12] : Floats{};
  const RgbLanes c0 = unpack(reinterpret_cast<Ints>(words[9]));
  const RgbLanes c1 = unpack(reinterpret_cast<Ints>(words[10]));
  const RgbLanes c2 = unpack(reinterpret_cast<Ints>(words[11]));
  const Floats one = Floats{} + 255.f;
  detail.color.r = (has ? interpolate(hits, c0.r, c1.r - c0.r, c2.r - c0.r) : one) * (1.f / 255.f);
  detail.color.g = (has ? interpolate(hits, c0.g, c1.g - c0.g, c2.g - c0.g) : one) * (1.f / 255.f);
  detail.color.b = (has ? interpolate(hits, c0.b, c1.b - c0.b, c2.b - c0.b) : one) * (1.f / 255.f);
  return detail;
}

/// The unit shading normal on the viewer's side of the geometric one.
struct FacingNormal {
  Floats x, y, z;
  Ints flipped;  // against the interpolated one
};

inline FacingNormal facing_normal(const Hits& hits, const Detail& detail) {
  const Floats facing = hits.nx * hits.d.x + hits.ny * hits.d.y + hits.nz * hits.d.z;
  const Floats aligned = hits.nx * detail.nx + hits.ny * detail.ny + hits.nz * detail.nz;
  const Floats length = sqrt_of(detail.nx * detail.nx + detail.ny * detail.ny + detail.nz * detail.nz);
  const Ints flip = (facing > 0.f) ^ (aligned < 0.f);
  const Floats scale = (flip ? Floats{} - 1.f : Floats{} + 1.f) / length;
  return {detail.nx * scale, detail.ny * scale, detail.nz * scale, flip};
}

}  // namespace
}  // namespace wiw::render::cpu
