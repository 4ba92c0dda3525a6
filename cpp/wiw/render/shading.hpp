// SPDX-License-Identifier: Apache-2.0
#pragma once

/// The numbers and formulas both back ends shade with, so that they agree. Nothing but plain arithmetic: the same
/// templates work on a float and on a SIMD vector, and the file is safe to include in objects built for one
/// instruction set (everything is inlined).
///
/// Colour of a hit (display-encoded, all in [0, 1] before rounding to 8 bits):
///   base_color x texture(uv) x vertex colour x light,
/// light = 2 x lightmap(lightmap_uv), or 1 if emissive, or ambient_light(normal) when there is no lightmap.
/// An emissive material ignores its lightmap.
///
/// Sun. In a scene with one, surfaces without lightmap that are not emissive have, instead of ambient_light(normal),
///   light = min(1, ambient x ambient_light(normal) + strength x max(0, normal . direction) x visibility)
/// with the viewer-facing shading normal. Visibility is 0 where any triangle, whichever way it faces, lies between the
/// point and the sun, holes of alpha cutouts let through, and 1 elsewhere. The point is lifted first: by shadow_offset
/// along the geometric normal towards the sun, against a surface shadowing itself by rounding; and where vertex normals
/// describe a curved surface, onto that one (shadow_lift), or its facets would shadow each other where light grazes it.
/// The ray caster decides visibility by a ray, with hard edges (colour samples smooth them); the GPU by a map of depths
/// along the sun's direction, fitted to the scene (`gpu/sun_map.hpp`), whose edges are three texels wide.
///
/// Filtering. Textures repeat and are sampled trilinearly from box-filtered mip levels of the encoded values
/// (`mipmap.hpp`). Lightmaps are clamped, bilinear, level 0 only: they are smooth, and mip levels would bleed across
/// charts. The level of detail is log2 of the longest side, in texels, of a pixel's footprint on the surface:
///   lod = log2(s * t * max(1, 1 / |n . d|) * density)
/// n: unit geometric normal; d: ray direction, scaled so that t is the value written as depth (perspective: d has
/// camera-space z of -1, t is planar depth; panorama: d has length 1, t is the distance); s: width of a pixel at t = 1
/// (perspective: 1 / focal length in pixels; panorama: max(pi / H, 2 pi / W * cos(latitude)) radians); density: the
/// largest stretch from metres to texels over the triangle (largest singular value of d(texel)/d(world)). This is what
/// GL's derivative rule max(|dT/dx|, |dT/dy|) bounds on a plane, from hit data alone. S samples per pixel lower the
/// level by log2(S) / 2.
///
/// Alpha cutout. A point is a hole when base_color.a x texture alpha < alpha_cutoff, alpha being bilinear at level 0.

namespace wiw::render::shading {

/// Nothing nearer is drawn: planar depth for perspective, distance for panoramas, metres.
constexpr float kNearClip = 0.01f;

/// Texels wider than this are pointless and float texel coordinates lose precision beyond.
constexpr int kMaxMipLevels = 16;

/// Light on a surface without a lightmap as a function of the unit shading normal alone: brighter from above, and
/// walls along X and Z told apart, so that a room's corners stay visible. At most 1.
/// The normal faces the viewer: take the interpolated normal (the geometric one where the mesh has none) and flip it
/// into the hemisphere of the geometric normal's viewer-facing side.
template <class Number>
[[gnu::always_inline]] inline Number ambient_light(Number nx, Number ny, Number nz) {
  return 0.80f + 0.12f * ny + 0.05f * (nx * nx - nz * nz) + 0.02f * nx;
}

/// Light under a sun: `ambient` is ambient_light(normal), `cosine` the normal times the sun's direction, `visibility`
/// between 0 and 1.
template <class Number>
[[gnu::always_inline]] inline Number sun_light(Number ambient, Number cosine, Number visibility, float ambient_share,
                                               float strength) {
  const Number direct = cosine > 0.f ? cosine * visibility : Number{};
  const Number light = ambient_share * ambient + strength * direct;
  return light < 1.f ? light : Number{} + 1.f;
}

/// Metres from a surface at depth `t` to where its ray to the sun starts: beyond the rounding of the point.
template <class Number>
[[gnu::always_inline]] inline Number shadow_offset(Number t) {
  return 2e-4f + 1e-5f * t;
}

/// Height of the curved surface over a triangle at barycentric coordinates u, v, for the triangle's `bulge`
/// (`bulge.hpp`): the mean height of the tangent planes at the vertices, when all edges bend alike.
template <class Number>
[[gnu::always_inline]] inline Number shadow_lift(Number bulge, Number u, Number v) {
  const Number w = 1.f - u - v;
  return 2.f * bulge * (u * v + v * w + w * u);
}

/// The greatest shadow_lift over a triangle, in bulges: what the GPU lifts by everywhere.
constexpr float kGreatestLift = 2.f / 3.f;

/// Weight of the zenith colour in the sky for a unit direction's Y; the rest is the horizon colour.
template <class Number>
[[gnu::always_inline]] inline Number sky_weight(Number dy) {
  return dy > Number{} ? dy : Number{};
}

/// Offset in pixels of sample (i, j), 0 <= i, j < n, from the pixel centre along one image axis, for n x n samples a
/// pixel: a sheared grid whose n * n samples have distinct columns and distinct rows (n = 2 is the rotated grid).
/// x = sample_offset(i, j, n), y = sample_offset(j, n - 1 - i, n).
constexpr float sample_offset(int coarse, int fine, int n) {
  const auto count = static_cast<float>(n);
  return (static_cast<float>(coarse) + (static_cast<float>(fine) + 0.5f) / count) / count - 0.5f;
}

}  // namespace wiw::render::shading
