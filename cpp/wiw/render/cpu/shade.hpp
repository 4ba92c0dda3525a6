// SPDX-License-Identifier: Apache-2.0
#pragma once

/// Colour of the hits of one packet. Included by kernel_body.hpp after a simd_*.hpp.

#include "wiw/render/cpu/sunlight.hpp"

namespace wiw::render::cpu {
namespace {

inline RgbLanes sky(const KernelScene& scene, const Directions& d) {
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

inline Floats ambient(const Hits& hits, const Detail& detail) {
  const FacingNormal n = facing_normal(hits, detail);
  return shading::ambient_light(n.x, n.y, n.z);
}

/// Colour of the packet as if all of its hits were on `surface`; `sunlit` is the light in a scene with a sun.
inline RgbLanes shade_surface(const KernelScene& scene, const ShadingSurface& surface, const Hits& hits,
                              Floats sunlit) {
  RgbLanes color{Floats{} + surface.base_color[0], Floats{} + surface.base_color[1], Floats{} + surface.base_color[2]};
  if (surface.texture != nullptr) {
    const Floats* uv = hits.record;
    const RgbLanes texel = sample_trilinear(*surface.texture, interpolate(hits, uv[0], uv[2], uv[4]),
                                            interpolate(hits, uv[1], uv[3], uv[5]), level_of_detail(hits));
    color = multiply(color, texel);
  }
  Floats light = Floats{} + 1.f;
  if (surface.vertex_colors || (surface.lightmap == nullptr && !surface.emissive)) {
    const Detail detail = load_detail(scene, hits);
    color = multiply(color, detail.color);
    if (surface.lightmap == nullptr && !surface.emissive) {
      light = scene.sun == nullptr ? ambient(hits, detail) : sunlit;
    }
  }
  if (surface.lightmap != nullptr && !surface.emissive) {
    const Floats* uv = hits.record + 6;
    const RgbLanes baked = sample_bilinear(*surface.lightmap, interpolate(hits, uv[0], uv[2], uv[4]),
                                           interpolate(hits, uv[1], uv[3], uv[5]));
    color = multiply(color, {2.f * baked.r, 2.f * baked.g, 2.f * baked.b});
  }
  return {saturate(color.r * light), saturate(color.g * light), saturate(color.b * light)};
}

/// Shades surface after surface: a packet mostly sees one or two, and within one all tables are scalars.
inline RgbLanes shade_hits(const KernelScene& scene, const Hits& hits, RgbLanes color) {
  const Ints surface = reinterpret_cast<Ints>(hits.record[12]);
  const Floats sunlit = scene.sun == nullptr ? Floats{} : sunlight(scene, hits);
  int left = mask_bits(hits.hit);
  while (left != 0) {
    const int number = surface[__builtin_ctz(static_cast<unsigned>(left))];
    const Ints mine = (surface == number) & hits.hit;
    const RgbLanes shaded = shade_surface(scene, scene.surfaces[number], hits, sunlit);
    color = {mine ? shaded.r : color.r, mine ? shaded.g : color.g, mine ? shaded.b : color.b};
    left &= ~mask_bits(mine);
  }
  return color;
}

}  // namespace
}  // namespace wiw::render::cpu
