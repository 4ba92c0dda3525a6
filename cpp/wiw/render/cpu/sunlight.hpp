// SPDX-License-Identifier: Apache-2.0
#pragma once

/// Light of the scene's sun on the hits of one packet. Included after a simd_*.hpp.

#include "wiw/render/cpu/hits.hpp"
#include "wiw/render/shading.hpp"

namespace wiw::render::cpu {
namespace {

/// Where the hits' rays to the sun start, see shading.hpp.
inline Directions lifted_points(const Sunlight& sun, const Hits& hits, const Detail& detail, const FacingNormal& n) {
  const Floats lift = n.flipped ? Floats{} : shading::shadow_lift(detail.bulge, hits.u, hits.v);
  const Floats length = sqrt_of(hits.nx * hits.nx + hits.ny * hits.ny + hits.nz * hits.nz);
  const Floats sunward = hits.nx * sun.direction[0] + hits.ny * sun.direction[1] + hits.nz * sun.direction[2];
  const Floats offset = shading::shadow_offset(hits.t);
  const Floats scale = (sunward < 0.f ? -offset : offset) / length;
  return {load_floats(hits.rays->ray.org_x) + hits.t * hits.d.x + lift * n.x + scale * hits.nx,
          load_floats(hits.rays->ray.org_y) + hits.t * hits.d.y + lift * n.y + scale * hits.ny,
          load_floats(hits.rays->ray.org_z) + hits.t * hits.d.z + lift * n.z + scale * hits.nz};
}

/// 1 for the valid lanes whose ray from `points` to the sun meets nothing.
inline Floats sun_visibility(const KernelScene& scene, const Directions& points, Ints valid) {
  alignas(64) Rays rays;
  store(rays.org_x, points.x);
  store(rays.org_y, points.y);
  store(rays.org_z, points.z);
  store(rays.dir_x, Floats{} + scene.sun->direction[0]);
  store(rays.dir_y, Floats{} + scene.sun->direction[1]);
  store(rays.dir_z, Floats{} + scene.sun->direction[2]);
  store(rays.tnear, Floats{});
  store(rays.tfar, Floats{} + __builtin_inff());
  store(rays.time, Floats{});
  store(rays.mask, Ints{} - 1);
  store(rays.id, Ints{});
  store(rays.flags, Ints{});
  RTCIntersectContext context;
  rtcInitIntersectContext(&context);
  context.flags = RTC_INTERSECT_CONTEXT_FLAG_COHERENT;
  const ValidLanes lanes(valid);
  occluded(lanes.lanes, scene.fixed, &context, &rays);
  // What is occluded by now has a negative end and is not traced again.
  if (scene.moved != nullptr) occluded(lanes.lanes, scene.moved, &context, &rays);
  return (load_floats(rays.tfar) > 0.f) & valid ? Floats{} + 1.f : Floats{};
}

/// `light` of every lane that was hit.
inline Floats sunlight(const KernelScene& scene, const Hits& hits) {
  const Sunlight& sun = *scene.sun;
  const Detail detail = load_detail(scene, hits);
  const FacingNormal n = facing_normal(hits, detail);
  const Floats cosine = n.x * sun.direction[0] + n.y * sun.direction[1] + n.z * sun.direction[2];
  const Ints turned = hits.hit & (cosine > 0.f);
  Floats visibility{};
  if (mask_bits(turned) != 0) visibility = sun_visibility(scene, lifted_points(sun, hits, detail, n), turned);
  return shading::sun_light(shading::ambient_light(n.x, n.y, n.z), cosine, visibility, sun.ambient, sun.strength);
}

}  // namespace
}  // namespace wiw::render::cpu
