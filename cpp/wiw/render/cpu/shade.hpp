// SPDX-License-Identifier: Apache-2.0
#pragma once

/// Colour of the hits of one packet. Included by kernel_body.hpp after a simd_*.hpp.

#include "wiw/render/cpu/sample.hpp"
#include "wiw/render/shading.hpp"

namespace wiw::cpu {
namespace {

struct Directions {
  Floats x, y, z;
};

/// One packet's hits: barycentric coordinates, depth, geometric normals (any length) and the triangles' records.
struct Hits {
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

inline Rgb sky(const KernelScene& scene, const Directions& d) {
  const Floats dy = d.y / sqrt_of(d.x * d.x + d.y * d.y + d.z * d.z);
  const Floats zenith = shading::sky_weight(dy);
  const auto mix = [&](int c) { return scene.horizon[c] + zenith * (scene.zenith[c] - scene.horizon[c]); };
  return {saturate(mix(0)), saturate(mix(1)), saturate(mix(2))};
}

/// See shading.hpp; squared quantities save the square roots.
inline Floats level_of_detail(const Hits& hits) {
  const Floats nn = hits.nx * hits.nx + hits.ny * hits.ny + hits.nz * hits.nz;
  const Floats nd = hits.nx * hits.d.x + hits.ny * hits.d.y + hits.nz * hits.d.z;
  const Floats stretch = nn / (nd * nd);
  const Floats footprint = hits.t * hits.t * hits.spread * (stretch > 1.f ? stretch : Floats{} + 1.f);
  return 0.5f * log2_of(footprint) + hits.record[14];
}

/// Interpolated vertex normals and colours of the triangles that have them; the geometric normal for the rest.
struct Detail {
  Floats nx, ny, nz;
  Rgb color;
};

inline Detail load_detail(const KernelScene& scene, const Hits& hits) {
  const Ints number = reinterpret_cast<Ints>(hits.record[15]);
  const Ints has = number != static_cast<std::int32_t>(kNoDetail);
  Floats words[kRecordWords];
  load_lines(scene.details, has ? number : Ints{}, words);
  Detail detail;
  const Floats nx = interpolate(hits, words[0], words[3], words[6]);
  const Floats ny = interpolate(hits, words[1], words[4], words[7]);
  const Floats nz = interpolate(hits, words[2], words[5], words[8]);
  const Ints smooth = has & (nx * nx + ny * ny + nz * nz > 1e-12f);
  detail.nx = smooth ? nx : hits.nx;
  detail.ny = smooth ? ny : hits.ny;
  detail.nz = smooth ? nz : hits.nz;
  const Rgb c0 = unpack(reinterpret_cast<Ints>(words[9]));
  const Rgb c1 = unpack(reinterpret_cast<Ints>(words[10]));
  const Rgb c2 = unpack(reinterpret_cast<Ints>(words[11]));
  const Floats one = Floats{} + 255.f;
  detail.color.r = (has ? interpolate(hits, c0.r, c1.r - c0.r, c2.r - c0.r) : one) * (1.f / 255.f);
  detail.color.g = (has ? interpolate(hits, c0.g, c1.g - c0.g, c2.g - c0.g) : one) * (1.f / 255.f);
  detail.color.b = (has ? interpolate(hits, c0.b, c1.b - c0.b, c2.b - c0.b) : one) * (1.f / 255.f);
  return detail;
}

/// Orients the shading normal to the viewer's side of the geometric one, then applies the shared formula.
inline Floats ambient(const Hits& hits, const Detail& detail) {
  const Floats facing = hits.nx * hits.d.x + hits.ny * hits.d.y + hits.nz * hits.d.z;
  const Floats aligned = hits.nx * detail.nx + hits.ny * detail.ny + hits.nz * detail.nz;
  const Floats length = sqrt_of(detail.nx * detail.nx + detail.ny * detail.ny + detail.nz * detail.nz);
  const Ints flip = (facing > 0.f) ^ (aligned < 0.f);
  const Floats scale = (flip ? Floats{} - 1.f : Floats{} + 1.f) / length;
  return shading::ambient_light(detail.nx * scale, detail.ny * scale, detail.nz * scale);
}

/// Colour of the packet as if all of its hits were on `surface`.
inline Rgb shade_surface(const KernelScene& scene, const Surface& surface, const Hits& hits) {
  Rgb color{Floats{} + surface.base_color[0], Floats{} + surface.base_color[1], Floats{} + surface.base_color[2]};
  if (surface.texture != nullptr) {
    const Floats* uv = hits.record;
    const Rgb texel = sample_trilinear(*surface.texture, interpolate(hits, uv[0], uv[2], uv[4]),
                                       interpolate(hits, uv[1], uv[3], uv[5]), level_of_detail(hits));
    color = multiply(color, texel);
  }
  Floats light = Floats{} + 1.f;
  if (surface.vertex_colors || (surface.lightmap == nullptr && !surface.emissive)) {
    const Detail detail = load_detail(scene, hits);
    color = multiply(color, detail.color);
    if (surface.lightmap == nullptr && !surface.emissive) light = ambient(hits, detail);
  }
  if (surface.lightmap != nullptr && !surface.emissive) {
    const Floats* uv = hits.record + 6;
    const Rgb baked = sample_bilinear(*surface.lightmap, interpolate(hits, uv[0], uv[2], uv[4]),
                                      interpolate(hits, uv[1], uv[3], uv[5]));
    color = multiply(color, {2.f * baked.r, 2.f * baked.g, 2.f * baked.b});
  }
  return {saturate(color.r * light), saturate(color.g * light), saturate(color.b * light)};
}

/// Shades surface after surface: a packet mostly sees one or two, and within one all tables are scalars.
inline Rgb shade_hits(const KernelScene& scene, const Hits& hits, Rgb color) {
  const Ints surface = reinterpret_cast<Ints>(hits.record[12]);
  int left = mask_bits(hits.hit);
  while (left != 0) {
    const int number = surface[__builtin_ctz(static_cast<unsigned>(left))];
    const Ints mine = (surface == number) & hits.hit;
    const Rgb shaded = shade_surface(scene, scene.surfaces[number], hits);
    color = {mine ? shaded.r : color.r, mine ? shaded.g : color.g, mine ? shaded.b : color.b};
    left &= ~mask_bits(mine);
  }
  return color;
}

}  // namespace
}  // namespace wiw::cpu
