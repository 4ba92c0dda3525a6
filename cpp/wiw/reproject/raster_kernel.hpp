// SPDX-License-Identifier: Apache-2.0
// Rasteriser of depth meshes, written as plain loops that the compiler turns into vector code; one object file per
// instruction set includes it. Internal linkage throughout, and no library headers, so that nothing compiled for a
// newer processor can be linked into code that runs on an older one.
//
// Nearly all quads cover about one target pixel. They are handled kLanes at a time: one loop finds every quad's box of
// pixel centres, then one loop per position in the box tests all of them at once. Quads with larger boxes, and those
// around a pole of the target, are intersected with the pixels' rays one by one.
#pragma once

#include "wiw/reproject/raster.hpp"

#if defined(__AVX2__)
#include <immintrin.h>
#endif

namespace wiw::reproject {
namespace {

constexpr int kSmallBox = 4;       // largest box, in pixels a side, that goes through the chunk loops
constexpr float kSlack = 1.0e-2F;  // barycentric tolerance: closes cracks where straight edges meet great circles
constexpr float kNear = 1.0e-3F;   // metres: nothing closer is drawn
constexpr float kOne14 = 16384.0F;

// The vectoriser believes __restrict only of the parameters of functions that are not inlined.
#define WIW_NOINLINE __attribute__((noinline))

inline float min_of(float a, float b) { return a < b ? a : b; }
inline float max_of(float a, float b) { return a > b ? a : b; }
inline int min_of(int a, int b) { return a < b ? a : b; }
inline int max_of(int a, int b) { return a > b ? a : b; }
inline float absolute(float a) { return a < 0.0F ? -a : a; }

inline int floor_int(float a) {
  const int t = static_cast<int>(a);
  return t - (static_cast<float>(t) > a ? 1 : 0);
}
inline int ceil_int(float a) {
  const int t = static_cast<int>(a);
  return t + (static_cast<float>(t) < a ? 1 : 0);
}

/// atan of [0, 1], |error| <= 2e-8 plus rounding (Abramowitz and Stegun, 4.4.49).
inline float atan_unit(float x) {
  const float s = x * x;
  float p = 0.0028662257F;
  p = p * s - 0.0161657367F;
  p = p * s + 0.0429096138F;
  p = p * s - 0.0752896400F;
  p = p * s + 0.1065626393F;
  p = p * s - 0.1420889944F;
  p = p * s + 0.1999355085F;
  p = p * s - 0.3333314528F;
  return x + x * s * p;
}

inline float atan2_fast(float y, float x) {
  const float ay = absolute(y);
  const float ax = absolute(x);
  const float low = min_of(ax, ay);
  const float high = max_of(max_of(ax, ay), 1.0e-30F);
  float angle = atan_unit(low / high);
  angle = ay > ax ? 1.57079632679F - angle : angle;
  angle = x < 0.0F ? 3.14159265359F - angle : angle;
  return y < 0.0F ? -angle : angle;
}

/// Vertices in the target camera: point, pixel coordinates, depth (not above kNear where not drawable).
struct Vertices {
  float *px, *py, *pz, *u, *v, *depth;
};

inline Vertices vertices_at(float* scratch, int count) {
  return {scratch, scratch + count, scratch + 2 * count, scratch + 3 * count, scratch + 4 * count, scratch + 5 * count};
}

/// Points (x, y, z) d of the source camera in the target camera; `y_step` 0 reads one y for all.
WIW_NOINLINE void transform(const float* matrix, const float* ray_x, const float* ray_y, int y_step, const float* ray_z,
                            float scale, const float* depth, int count, float* __restrict px, float* __restrict py,
                            float* __restrict pz) {
  const float t0 = matrix[0], t1 = matrix[1], t2 = matrix[2], t3 = matrix[3], t4 = matrix[4], t5 = matrix[5];
  const float t6 = matrix[6], t7 = matrix[7], t8 = matrix[8], t9 = matrix[9], t10 = matrix[10], t11 = matrix[11];
  if (y_step == 0) {
    const float level = ray_y[0];
    for (int j = 0; j < count; ++j) {
      const float d = depth[j];
      const float x = ray_x[j] * scale * d;
      const float z = ray_z[j] * scale * d;
      const float y = level * d;
      px[j] = t0 * x + t1 * y + t2 * z + t3;
      py[j] = t4 * x + t5 * y + t6 * z + t7;
      pz[j] = t8 * x + t9 * y + t10 * z + t11;
    }
    return;
  }
  for (int j = 0; j < count; ++j) {
    const float d = depth[j];
    const float x = ray_x[j] * scale * d;
    const float z = ray_z[j] * scale * d;
    const float y = ray_y[j] * d;
    px[j] = t0 * x + t1 * y + t2 * z + t3;
    py[j] = t4 * x + t5 * y + t6 * z + t7;
    pz[j] = t8 * x + t9 * y + t10 * z + t11;
  }
}

WIW_NOINLINE void project_panorama(const RasterJob& job, const float* px, const float* py, const float* pz, int count,
                                   float* __restrict u, float* __restrict v, float* __restrict depth) {
  const float across = static_cast<float>(job.width) * 0.15915494309F;
  const float down = static_cast<float>(job.height) * 0.31830988618F;
  const float middle_u = static_cast<float>(job.width) * 0.5F - 0.5F;
  const float middle_v = static_cast<float>(job.height) * 0.5F - 0.5F;
  for (int j = 0; j < count; ++j) {
    const float flat2 = px[j] * px[j] + pz[j] * pz[j];
    u[j] = middle_u + across * atan2_fast(px[j], -pz[j]);
    v[j] = middle_v - down * atan2_fast(py[j], __builtin_sqrtf(flat2));
    depth[j] = __builtin_sqrtf(flat2 + py[j] * py[j]);
  }
}

WIW_NOINLINE void project_pinhole(const RasterJob& job, const float* px, const float* py, const float* pz, int count,
                                  float* __restrict u, float* __restrict v, float* __restrict depth) {
  const float focal = job.focal;
  const float middle_u = static_cast<float>(job.width) * 0.5F - 0.5F;
  const float middle_v = static_cast<float>(job.height) * 0.5F - 0.5F;
  // Keeps far-off vertices within the range of int conversions.
  const float limit = 1.0e6F;
  for (int j = 0; j < count; ++j) {
    const float z = -pz[j];
    const float scale = focal / max_of(z, kNear);
    u[j] = max_of(-limit, min_of(limit, middle_u + scale * px[j]));
    v[j] = max_of(-limit, min_of(limit, middle_v - scale * py[j]));
    depth[j] = z;
  }
}

inline void project(const RasterJob& job, const Vertices& out, int count) {
  if (job.panoramic) {
    project_panorama(job, out.px, out.py, out.pz, count, out.u, out.v, out.depth);
  } else {
    project_pinhole(job, out.px, out.py, out.pz, count, out.u, out.v, out.depth);
  }
}

inline void build_row(const RasterJob& job, int row, const Vertices& out) {
  transform(job.transform, job.ray_x, job.ray_y + row, 0, job.ray_z, job.ray_m[row],
            job.depth + static_cast<std::size_t>(row) * job.columns, job.columns, out.px, out.py, out.pz);
  project(job, out, job.columns);
}

/// Depth test and write of one sample.
inline void put(const RasterJob& job, int u, int v, float depth, std::uint32_t texel, std::uint32_t fraction) {
  if (u < 0) u += job.width;
  if (u >= job.width) u -= job.width;
  const std::size_t i = static_cast<std::size_t>(v) * static_cast<std::size_t>(job.width) + static_cast<std::size_t>(u);
  if (depth < job.out_depth[i]) {
    job.out_depth[i] = depth;
    job.out_texel[i] = texel;
    job.out_fraction14[i] = fraction;
  }
}

/// Fraction in 1/16384 at position a in [0, 1] between both ends of a quad.
inline int fraction14(float begin, float span, float a) {
  const float f = (begin + span * a) * kOne14;
  return static_cast<int>(max_of(0.0F, min_of(kOne14, f)) + 0.5F);
}

/// Quads by their corners 00 01 10 11 (row, column): vertices, and where they lie in the source image.
struct Quads {
  Vertices corner[4];
  const std::uint8_t* triangles;
  const std::uint32_t* texel;
  std::uint32_t texel_row;  // added to texel
  const float *begin_x, *span_x, *begin_y, *span_y;
  int y_step;  // 0 reads one begin_y and span_y for all
};

inline Vertices advance(const Vertices& v, int n) {
  return {v.px + n, v.py + n, v.pz + n, v.u + n, v.v + n, v.depth + n};
}

inline Quads advance(const Quads& quads, int n) {
  Quads moved = quads;
  for (Vertices& corner : moved.corner) corner = advance(corner, n);
  moved.triangles += n;
  moved.texel += n;
  moved.begin_x += n;
  moved.span_x += n;
  moved.begin_y += n * quads.y_step;
  moved.span_y += n * quads.y_step;
  return moved;
}

/// What is known of up to kLanes quads before and after testing one position of their boxes.
struct QuadChunk {
  float u00[kLanes], u01[kLanes], u10[kLanes], u11[kLanes];  // on the same side of the seam
  float inverse_upper[kLanes], inverse_lower[kLanes];        // 1 / area, 0 where there is no triangle
  int left[kLanes], top[kLanes], width[kLanes], height[kLanes];
  int large[kLanes];
  int hit[kLanes], hit_u[kLanes], hit_v[kLanes], fraction[kLanes];
  float hit_depth[kLanes];
};

/// Difference of columns on the shorter way round.
inline float unwrap(float difference, float turn) {
  const float half = 0.5F * turn;
  return difference > half ? difference - turn : (difference < -half ? difference + turn : difference);
}

/// Bit k is set where values[k] is not 0.
inline unsigned set_lanes(const int* values) {
#if defined(__AVX512F__)
  const __m512i all = _mm512_loadu_si512(values);
  return _mm512_test_epi32_mask(all, all);
#elif defined(__AVX2__)
  const auto half = [](const int* from) {
    const __m256i some = _mm256_loadu_si256(reinterpret_cast<const __m256i*>(from));
    return static_cast<unsigned>(
        _mm256_movemask_ps(_mm256_castsi256_ps(_mm256_cmpgt_epi32(some, _mm256_setzero_si256()))));
  };
  return half(values) | (half(values + 8) << 8);
#else
  unsigned set = 0;
  for (int k = 0; k < kLanes; ++k) set |= static_cast<unsigned>(values[k] != 0 ? 1 : 0) << k;
  return set;
#endif
}

inline float inverse_or_zero(float area) { return absolute(area) > 1.0e-12F ? 1.0F / area : 0.0F; }

struct ChunkExtent {
  int width, height, any_large;
};

/// Fills corners and boxes of a chunk; returns the largest box that the chunk loops take.
WIW_NOINLINE ChunkExtent bound_chunk(const RasterJob& job, const Quads& quads, QuadChunk& __restrict chunk) {
  // A pinhole image does not wrap: a turn longer than any difference leaves it alone.
  const float turn = job.panoramic ? static_cast<float>(job.width) : 1.0e9F;
  const int low_u = job.panoramic ? -job.width : 0;
  const int high_u = job.panoramic ? 2 * job.width - 1 : job.width - 1;
  const int high_v = job.height - 1;
  const float *u0 = quads.corner[0].u, *u1 = quads.corner[1].u, *u2 = quads.corner[2].u, *u3 = quads.corner[3].u;
  const float *v0 = quads.corner[0].v, *v1 = quads.corner[1].v, *v2 = quads.corner[2].v, *v3 = quads.corner[3].v;
  const float *d0 = quads.corner[0].depth, *d1 = quads.corner[1].depth;
  const float *d2 = quads.corner[2].depth, *d3 = quads.corner[3].depth;
  // Apart, because loops of one element size are vectorised best.
  int triangles[kLanes];
  for (int k = 0; k < kLanes; ++k) triangles[k] = quads.triangles[k];
  int widest = 0;
  int highest = 0;
  int any_large = 0;
  for (int k = 0; k < kLanes; ++k) {
    const float d01 = unwrap(u1[k] - u0[k], turn);
    const float d10 = unwrap(u2[k] - u0[k], turn);
    const float d11 = unwrap(u3[k] - u0[k], turn);
    // Around a pole the four steps do not close.
    const float loop = d01 + unwrap(u3[k] - u1[k], turn) + unwrap(u2[k] - u3[k], turn) - d10;
    chunk.u00[k] = u0[k];
    chunk.u01[k] = u0[k] + d01;
    chunk.u10[k] = u0[k] + d10;
    chunk.u11[k] = u0[k] + d11;
    const float low_x = u0[k] + min_of(min_of(0.0F, d01), min_of(d10, d11));
    const float high_x = u0[k] + max_of(max_of(0.0F, d01), max_of(d10, d11));
    const float low_y = min_of(min_of(v0[k], v1[k]), min_of(v2[k], v3[k]));
    const float high_y = max_of(max_of(v0[k], v1[k]), max_of(v2[k], v3[k]));
    const int left = max_of(low_u, ceil_int(low_x - 1.0e-3F));
    const int top = max_of(0, ceil_int(low_y - 1.0e-3F));
    const int width = min_of(high_u, floor_int(high_x + 1.0e-3F)) - left + 1;
    const int height = min_of(high_v, floor_int(high_y + 1.0e-3F)) - top + 1;
    const float nearest = min_of(min_of(d0[k], d1[k]), min_of(d2[k], d3[k]));
    const int pole = absolute(loop) > 1.0F ? 1 : 0;
    const int drawn = (triangles[k] != 0 ? 1 : 0) & (nearest > kNear ? 1 : 0);
    const int covers = (width > 0 ? 1 : 0) & (height > 0 ? 1 : 0);
    const int big = (width > kSmallBox ? 1 : 0) | (height > kSmallBox ? 1 : 0);
    // A wide quad may bulge over a row's centre that its corners do not reach.
    const int large = drawn & (pole | (big & (width > 0 ? 1 : 0)));
    const int small = drawn & (1 - large) & covers;
    chunk.large[k] = large;
    chunk.left[k] = left;
    chunk.top[k] = top;
    chunk.width[k] = small != 0 ? width : 0;
    chunk.height[k] = small != 0 ? height : 0;
    widest = max_of(widest, small != 0 ? width : 0);
    highest = max_of(highest, small != 0 ? height : 0);
    any_large |= large;
    const float upper = d01 * (v2[k] - v0[k]) - (v1[k] - v0[k]) * d10;
    const float lower = (d10 - d11) * (v1[k] - v3[k]) - (v2[k] - v3[k]) * (d01 - d11);
    chunk.inverse_upper[k] = (triangles[k] & 1) != 0 ? inverse_or_zero(upper) : 0.0F;
    chunk.inverse_lower[k] = (triangles[k] & 2) != 0 ? inverse_or_zero(lower) : 0.0F;
  }
  return {widest, highest, any_large};
}

/// Tests position (step_u, step_v) of every box in the chunk.
template <bool kOneRow>
WIW_NOINLINE void test_chunk(const Quads& quads, int step_u, int step_v, QuadChunk& __restrict chunk) {
  const float *v0 = quads.corner[0].v, *v1 = quads.corner[1].v, *v2 = quads.corner[2].v, *v3 = quads.corner[3].v;
  const float *d0 = quads.corner[0].depth, *d1 = quads.corner[1].depth;
  const float *d2 = quads.corner[2].depth, *d3 = quads.corner[3].depth;
  const float *begin_x = quads.begin_x, *span_x = quads.span_x;
  const float *begin_y = quads.begin_y, *span_y = quads.span_y;
  for (int k = 0; k < kLanes; ++k) {
    const int u = chunk.left[k] + step_u;
    const int v = chunk.top[k] + step_v;
    const float x = static_cast<float>(u);
    const float y = static_cast<float>(v);
    // Upper left triangle: p = p00 + a (p01 - p00) + b (p10 - p00).
    const float qx = x - chunk.u00[k];
    const float qy = y - v0[k];
    const float a1 = (qx * (v2[k] - v0[k]) - qy * (chunk.u10[k] - chunk.u00[k])) * chunk.inverse_upper[k];
    const float b1 = ((chunk.u01[k] - chunk.u00[k]) * qy - (v1[k] - v0[k]) * qx) * chunk.inverse_upper[k];
    const int in1 = (a1 >= -kSlack ? 1 : 0) & (b1 >= -kSlack ? 1 : 0) & (a1 + b1 <= 1.0F + kSlack ? 1 : 0) &
                    (chunk.inverse_upper[k] != 0.0F ? 1 : 0);
    const float z1 = d0[k] + a1 * (d1[k] - d0[k]) + b1 * (d2[k] - d0[k]);
    // Lower right triangle: p = p11 + a (p10 - p11) + b (p01 - p11).
    const float rx = x - chunk.u11[k];
    const float ry = y - v3[k];
    const float a2 = (rx * (v1[k] - v3[k]) - ry * (chunk.u01[k] - chunk.u11[k])) * chunk.inverse_lower[k];
    const float b2 = ((chunk.u10[k] - chunk.u11[k]) * ry - (v2[k] - v3[k]) * rx) * chunk.inverse_lower[k];
    const int in2 = (a2 >= -kSlack ? 1 : 0) & (b2 >= -kSlack ? 1 : 0) & (a2 + b2 <= 1.0F + kSlack ? 1 : 0) &
                    (chunk.inverse_lower[k] != 0.0F ? 1 : 0);
    const float z2 = d3[k] + a2 * (d2[k] - d3[k]) + b2 * (d1[k] - d3[k]);
    const float a = in1 != 0 ? a1 : 1.0F - a2;
    const float b = in1 != 0 ? b1 : 1.0F - b2;
    const int behind = (in1 != 0 ? chunk.inverse_upper[k] : chunk.inverse_lower[k]) < 0.0F ? kBehind : 0;
    chunk.hit_depth[k] = in1 != 0 ? z1 : z2;
    chunk.fraction[k] = fraction14(begin_x[k], span_x[k], a) |
                        (fraction14(begin_y[kOneRow ? 0 : k], span_y[kOneRow ? 0 : k], b) << 16) | behind;
    chunk.hit_u[k] = u;
    chunk.hit_v[k] = v;
    chunk.hit[k] = (step_u < chunk.width[k] ? 1 : 0) & (step_v < chunk.height[k] ? 1 : 0) & (in1 | in2);
  }
}

inline void put_chunk(const RasterJob& job, const Quads& quads, const QuadChunk& chunk) {
  for (unsigned left = set_lanes(chunk.hit); left != 0; left &= left - 1) {
    const int k = __builtin_ctz(left);
    put(job, chunk.hit_u[k], chunk.hit_v[k], chunk.hit_depth[k], quads.texel[k] + quads.texel_row,
        static_cast<std::uint32_t>(chunk.fraction[k]));
  }
}

struct RayVector {
  float x, y, z;
};
inline RayVector operator-(const RayVector& a, const RayVector& b) { return {a.x - b.x, a.y - b.y, a.z - b.z}; }
inline RayVector cross(const RayVector& a, const RayVector& b) {
  return {a.y * b.z - a.z * b.y, a.z * b.x - a.x * b.z, a.x * b.y - a.y * b.x};
}
inline float dot(const RayVector& a, const RayVector& b) { return a.x * b.x + a.y * b.y + a.z * b.z; }
inline RayVector point(const Vertices& vertices, int k) { return {vertices.px[k], vertices.py[k], vertices.pz[k]}; }

/// Triangle corner + a side_a + b side_b, prepared for rays from the origin (Moeller and Trumbore 1997, with all but
/// the ray's direction factored out): a = normal_a . d / n . d, likewise b; the depth is n . corner / n . d. normal_a
/// and normal_b are perpendicular to the corner, so the ray through it, `origin`, is taken off d first: what is left is
/// as small as the triangle, and so are the errors.
struct RayTriangle {
  RayVector normal, normal_a, normal_b, origin;
  float offset;
};

/// `depth` is the corner's.
inline RayTriangle ray_triangle(const RayVector& corner, float depth, const RayVector& end_a, const RayVector& end_b) {
  const RayVector side_a = end_a - corner;
  const RayVector side_b = end_b - corner;
  const RayVector normal = cross(side_a, side_b);
  const float scale = 1.0F / depth;
  const RayVector origin{corner.x * scale, corner.y * scale, corner.z * scale};
  return {normal, cross(side_b, corner), cross(corner, side_a), origin, dot(normal, corner)};
}

/// Results of kLanes rays.
struct Lanes {
  int set[kLanes];
  float a[kLanes], b[kLanes], depth[kLanes];
};

struct PixelBox {
  int left, right, top, bottom;  // inclusive
};

/// Where the rays of kLanes pixels from column `left` of row v meet the triangle.
WIW_NOINLINE void meet_rays(const RasterJob& job, const RayTriangle& triangle, int left, int right, int v, bool flip,
                            Lanes& __restrict lanes) {
  const float *ray_x = job.target_ray_x + left, *ray_z = job.target_ray_z + left;
  const float m = job.target_ray_m[v];
  const float y = job.target_ray_y[v];
  const RayVector n = triangle.normal, normal_a = triangle.normal_a, normal_b = triangle.normal_b;
  const RayVector origin = triangle.origin;
  const float offset = triangle.offset;
  const float dy = y - origin.y;
  const int count = right - left + 1;
  for (int k = 0; k < kLanes; ++k) {
    const float x = ray_x[k] * m;
    const float z = ray_z[k] * m;
    const float dx = x - origin.x;
    const float dz = z - origin.z;
    // Parallel rays divide by zero; what comes of it is inside nothing.
    const float inverse = 1.0F / (n.x * x + n.y * y + n.z * z);
    const float a = (normal_a.x * dx + normal_a.y * dy + normal_a.z * dz) * inverse;
    const float b = (normal_b.x * dx + normal_b.y * dy + normal_b.z * dz) * inverse;
    const float depth = offset * inverse;
    lanes.set[k] = (a >= -kSlack ? 1 : 0) & (b >= -kSlack ? 1 : 0) & (a + b <= 1.0F + kSlack ? 1 : 0) &
                   (depth > kNear ? 1 : 0) & (k < count ? 1 : 0);
    lanes.a[k] = flip ? 1.0F - a : a;
    lanes.b[k] = flip ? 1.0F - b : b;
    lanes.depth[k] = depth;
  }
}

/// Draws one triangle of quad k over a box of pixels; `flip` for the lower right triangle, whose corner is 11.
inline void draw_triangle(const RasterJob& job, const Quads& quads, int k, const RayTriangle& triangle, bool flip,
                          const PixelBox& box) {
  const std::uint32_t texel = quads.texel[k] + quads.texel_row;
  // The normal points away from the source.
  const int behind = triangle.offset < 0.0F ? kBehind : 0;
  Lanes lanes;
  for (int v = box.top; v <= box.bottom; ++v) {
    for (int left = box.left; left <= box.right; left += kLanes) {
      meet_rays(job, triangle, left, box.right, v, flip, lanes);
      for (unsigned set = set_lanes(lanes.set); set != 0; set &= set - 1) {
        const int lane = __builtin_ctz(set);
        const int fx = fraction14(quads.begin_x[k], quads.span_x[k], lanes.a[lane]);
        const int fy = fraction14(quads.begin_y[k * quads.y_step], quads.span_y[k * quads.y_step], lanes.b[lane]);
        put(job, left + lane, v, lanes.depth[lane], texel, static_cast<std::uint32_t>(fx | (fy << 16) | behind));
      }
    }
  }
}

/// Pixels that a large quad may cover.
inline PixelBox large_box(const RasterJob& job, const Quads& quads, int k, const QuadChunk& chunk) {
  float left = min_of(min_of(chunk.u00[k], chunk.u01[k]), min_of(chunk.u10[k], chunk.u11[k]));
  float right = max_of(max_of(chunk.u00[k], chunk.u01[k]), max_of(chunk.u10[k], chunk.u11[k]));
  const float v0 = quads.corner[0].v[k], v1 = quads.corner[1].v[k], v2 = quads.corner[2].v[k];
  const float v3 = quads.corner[3].v[k];
  float top = min_of(min_of(v0, v1), min_of(v2, v3));
  float bottom = max_of(max_of(v0, v1), max_of(v2, v3));
  const auto width = static_cast<float>(job.width);
  const auto height = static_cast<float>(job.height);
  if (job.panoramic) {
    // Great circles bulge towards the pole: by a row at most while the quad spans little longitude, and a quad that
    // spans much of it may hold the pole.
    const bool wide = right - left > 0.2F * width;
    if (top + bottom < height) {
      top = wide ? 0.0F : top - 1.0F;
    } else {
      bottom = wide ? height - 1.0F : bottom + 1.0F;
    }
    left = wide ? 0.0F : left;
    right = wide ? width - 1.0F : right;
  } else {
    left = max_of(left, 0.0F);
    right = min_of(right, width - 1.0F);
  }
  return {ceil_int(left - 1.0e-3F), floor_int(right + 1.0e-3F), max_of(0, ceil_int(top - 1.0e-3F)),
          min_of(job.height - 1, floor_int(bottom + 1.0e-3F))};
}

/// Draws a quad that the chunk loops do not take.
inline void draw_large(const RasterJob& job, const Quads& quads, int k, const QuadChunk& chunk) {
  const PixelBox box = large_box(job, quads, k, chunk);
  const RayVector p00 = point(quads.corner[0], k);
  const RayVector p01 = point(quads.corner[1], k);
  const RayVector p10 = point(quads.corner[2], k);
  const RayVector p11 = point(quads.corner[3], k);
  if ((quads.triangles[k] & 1) != 0)
    draw_triangle(job, quads, k, ray_triangle(p00, quads.corner[0].depth[k], p01, p10), false, box);
  if ((quads.triangles[k] & 2) != 0)
    draw_triangle(job, quads, k, ray_triangle(p11, quads.corner[3].depth[k], p10, p01), true, box);
}

template <bool kOneRow>
inline void draw_quads(const RasterJob& job, const Quads& all, int count, QuadChunk& chunk) {
  for (int first = 0; first < count; first += kLanes) {
    const Quads quads = advance(all, first);
    const ChunkExtent box = bound_chunk(job, quads, chunk);
    for (int step_v = 0; step_v < box.height; ++step_v) {
      for (int step_u = 0; step_u < box.width; ++step_u) {
        test_chunk<kOneRow>(quads, step_u, step_v, chunk);
        put_chunk(job, quads, chunk);
      }
    }
    if (box.any_large == 0) continue;
    for (int k = 0; k < kLanes; ++k) {
      if (chunk.large[k] != 0) draw_large(job, quads, k, chunk);
    }
  }
}

/// The mesh's quads between two rows of vertices.
inline Quads quad_row(const RasterJob& job, int row, const Vertices& upper, const Vertices& lower) {
  return {{upper, advance(upper, 1), lower, advance(lower, 1)},
          job.triangles + static_cast<std::size_t>(row) * padded_lanes(job.columns),
          job.texel_across,
          job.texel_down[row] << 16,
          job.begin_across,
          job.span_across,
          job.begin_down + row,
          job.span_down + row,
          0};
}

inline void draw_mesh(const RasterJob& job, QuadChunk& chunk) {
  Vertices upper = vertices_at(job.scratch, padded_lanes(job.columns));
  Vertices lower =
      vertices_at(job.scratch + 6 * static_cast<std::ptrdiff_t>(padded_lanes(job.columns)), padded_lanes(job.columns));
  build_row(job, 0, upper);
  for (int row = 0; row + 1 < job.rows; ++row) {
    build_row(job, row + 1, lower);
    draw_quads<true>(job, quad_row(job, row, upper, lower), job.columns - 1, chunk);
    const Vertices swap = upper;
    upper = lower;
    lower = swap;
  }
}

/// The fringe's quads, a few hundred at a time so that the vertices stay in the cache.
inline void draw_fringe(const RasterJob& job, QuadChunk& chunk) {
  const Fringe& fringe = job.fringe;
  for (int first = 0; first < fringe.count; first += kFringeBlock) {
    const int count = min_of(kFringeBlock, fringe.count - first);
    Quads quads{{},
                fringe.triangles + first,
                fringe.texel + first,
                0,
                fringe.begin_x + first,
                fringe.span_x + first,
                fringe.begin_y + first,
                fringe.span_y + first,
                1};
    for (int corner = 0; corner < 4; ++corner) {
      quads.corner[corner] = vertices_at(job.scratch + 6 * corner * kFringeBlock, kFringeBlock);
      const Vertices& out = quads.corner[corner];
      transform(job.transform, fringe.ray_x[corner] + first, fringe.ray_y[corner] + first, 1,
                fringe.ray_z[corner] + first, 1.0F, fringe.depth[corner] + first, count, out.px, out.py, out.pz);
      project(job, out, count);
    }
    draw_quads<false>(job, quads, count, chunk);
  }
}

inline void raster(const RasterJob& job) {
  QuadChunk chunk;
  draw_mesh(job, chunk);
  draw_fringe(job, chunk);
}

}  // namespace
}  // namespace wiw::reproject
