// SPDX-License-Identifier: Apache-2.0
// Rasteriser of depth meshes, written as plain loops that the compiler turns into vector code; one object file per
// instruction set includes it. Internal linkage throughout, and no library headers, so that nothing compiled for a
// newer processor can be linked into code that runs on an older one.
//
// Nearly all quads cover about one target pixel. They are handled in chunks: one loop finds every quad's box of pixel
// centres, then one loop per position in the box tests all quads of the chunk at once. Quads with larger boxes, and
// those around a pole of the target, are intersected with the pixels' rays one by one.
#pragma once

#include "wiw/reproject/raster.hpp"

namespace wiw::reproject {
namespace {

constexpr int kChunk = 64;
constexpr int kSmallBox = 4;       // largest box, in pixels a side, that goes through the chunk loops
constexpr float kSlack = 1.0e-4F;  // barycentric tolerance that closes cracks between neighbours
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

/// One row of vertices in the target camera: point, pixel coordinates, depth (not above kNear where not drawable).
struct VertexRow {
  float *px, *py, *pz, *u, *v, *depth;
};

inline VertexRow vertex_row(float* scratch, int columns) {
  return {scratch,
          scratch + columns,
          scratch + 2 * columns,
          scratch + 3 * columns,
          scratch + 4 * columns,
          scratch + 5 * columns};
}

WIW_NOINLINE void transform_row(const RasterJob& job, int row, float* __restrict px, float* __restrict py,
                                float* __restrict pz) {
  const float* depth = job.depth + static_cast<std::size_t>(row) * job.columns;
  const float m = job.ray_m[row];
  const float y = job.ray_y[row];
  const float* t = job.transform;
  const float t0 = t[0], t1 = t[1], t2 = t[2], t3 = t[3], t4 = t[4], t5 = t[5];
  const float t6 = t[6], t7 = t[7], t8 = t[8], t9 = t[9], t10 = t[10], t11 = t[11];
  const float *ray_x = job.ray_x, *ray_z = job.ray_z;
  for (int j = 0; j < job.columns; ++j) {
    const float d = depth[j];
    const float x = ray_x[j] * m * d;
    const float z = ray_z[j] * m * d;
    const float h = y * d;
    px[j] = t0 * x + t1 * h + t2 * z + t3;
    py[j] = t4 * x + t5 * h + t6 * z + t7;
    pz[j] = t8 * x + t9 * h + t10 * z + t11;
  }
}

WIW_NOINLINE void project_panorama(const RasterJob& job, const float* px, const float* py, const float* pz,
                                   float* __restrict u, float* __restrict v, float* __restrict depth) {
  const float across = static_cast<float>(job.width) * 0.15915494309F;
  const float down = static_cast<float>(job.height) * 0.31830988618F;
  const float middle_u = static_cast<float>(job.width) * 0.5F - 0.5F;
  const float middle_v = static_cast<float>(job.height) * 0.5F - 0.5F;
  for (int j = 0; j < job.columns; ++j) {
    const float flat2 = px[j] * px[j] + pz[j] * pz[j];
    u[j] = middle_u + across * atan2_fast(px[j], -pz[j]);
    v[j] = middle_v - down * atan2_fast(py[j], __builtin_sqrtf(flat2));
    depth[j] = __builtin_sqrtf(flat2 + py[j] * py[j]);
  }
}

WIW_NOINLINE void project_pinhole(const RasterJob& job, const float* px, const float* py, const float* pz,
                                  float* __restrict u, float* __restrict v, float* __restrict depth) {
  const float focal = job.focal;
  const float middle_u = static_cast<float>(job.width) * 0.5F - 0.5F;
  const float middle_v = static_cast<float>(job.height) * 0.5F - 0.5F;
  // Keeps far-off vertices within the range of int conversions.
  const float limit = 1.0e6F;
  for (int j = 0; j < job.columns; ++j) {
    const float z = -pz[j];
    const float scale = focal / max_of(z, kNear);
    u[j] = max_of(-limit, min_of(limit, middle_u + scale * px[j]));
    v[j] = max_of(-limit, min_of(limit, middle_v - scale * py[j]));
    depth[j] = z;
  }
}

inline void build_row(const RasterJob& job, int row, const VertexRow& out) {
  transform_row(job, row, out.px, out.py, out.pz);
  if (job.panoramic) {
    project_panorama(job, out.px, out.py, out.pz, out.u, out.v, out.depth);
  } else {
    project_pinhole(job, out.px, out.py, out.pz, out.u, out.v, out.depth);
  }
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

/// Quads [first, first + count) of the row between two vertex rows: corners relative to the seam, boxes, triangles.
struct Chunk {
  float u00[kChunk], u01[kChunk], u10[kChunk], u11[kChunk];
  float inverse_upper[kChunk], inverse_lower[kChunk];
  int left[kChunk], top[kChunk], width[kChunk], height[kChunk];
  int large[kChunk];
  // Results of one box position.
  int hit[kChunk], hit_u[kChunk], hit_v[kChunk], fraction_x[kChunk], fraction_y[kChunk];
  float hit_depth[kChunk];
};

/// Difference of columns on the shorter way round.
inline float unwrap(float difference, float turn) {
  const float half = 0.5F * turn;
  return difference > half ? difference - turn : (difference < -half ? difference + turn : difference);
}

inline float inverse_or_zero(float area) { return absolute(area) > 1.0e-12F ? 1.0F / area : 0.0F; }

struct Box {
  int width, height;
};

/// Fills corners and boxes of a chunk; returns the largest small box.
inline Box bound_chunk(const RasterJob& job, const VertexRow& upper, const VertexRow& lower,
                       const std::uint8_t* triangles, int first, int count, Chunk& chunk) {
  // A pinhole image does not wrap: a turn longer than any difference leaves it alone.
  const float turn = job.panoramic ? static_cast<float>(job.width) : 1.0e9F;
  const int low_u = job.panoramic ? -job.width : 0;
  const int high_u = job.panoramic ? 2 * job.width - 1 : job.width - 1;
  const int high_v = job.height - 1;
  const float *uu = upper.u + first, *uv = upper.v + first, *ud = upper.depth + first;
  const float *lu = lower.u + first, *lv = lower.v + first, *ld = lower.depth + first;
  int widest = 0;
  int highest = 0;
  for (int k = 0; k < count; ++k) {
    const float d01 = unwrap(uu[k + 1] - uu[k], turn);
    const float d10 = unwrap(lu[k] - uu[k], turn);
    const float d11 = unwrap(lu[k + 1] - uu[k], turn);
    // Around a pole the four steps do not close.
    const float loop = d01 + unwrap(lu[k + 1] - uu[k + 1], turn) + unwrap(lu[k] - lu[k + 1], turn) - d10;
    chunk.u00[k] = uu[k];
    chunk.u01[k] = uu[k] + d01;
    chunk.u10[k] = uu[k] + d10;
    chunk.u11[k] = uu[k] + d11;
    const float low_x = uu[k] + min_of(min_of(0.0F, d01), min_of(d10, d11));
    const float high_x = uu[k] + max_of(max_of(0.0F, d01), max_of(d10, d11));
    const float low_y = min_of(min_of(uv[k], uv[k + 1]), min_of(lv[k], lv[k + 1]));
    const float high_y = max_of(max_of(uv[k], uv[k + 1]), max_of(lv[k], lv[k + 1]));
    const int left = max_of(low_u, ceil_int(low_x - 1.0e-3F));
    const int top = max_of(0, ceil_int(low_y - 1.0e-3F));
    const int width = min_of(high_u, floor_int(high_x + 1.0e-3F)) - left + 1;
    const int height = min_of(high_v, floor_int(high_y + 1.0e-3F)) - top + 1;
    const float nearest = min_of(min_of(ud[k], ud[k + 1]), min_of(ld[k], ld[k + 1]));
    const int pole = absolute(loop) > 1.0F ? 1 : 0;
    const int drawn = (triangles[first + k] != 0 ? 1 : 0) & (nearest > kNear ? 1 : 0);
    const int large =
        drawn & (pole | (((width > kSmallBox ? 1 : 0) | (height > kSmallBox ? 1 : 0)) & (width > 0 ? 1 : 0)));
    const int small = drawn & (1 - large) & (width > 0 ? 1 : 0) & (height > 0 ? 1 : 0);
    chunk.large[k] = large;
    chunk.left[k] = left;
    chunk.top[k] = top;
    chunk.width[k] = small != 0 ? width : 0;
    chunk.height[k] = small != 0 ? height : 0;
    widest = max_of(widest, small != 0 ? width : 0);
    highest = max_of(highest, small != 0 ? height : 0);
    chunk.inverse_upper[k] =
        (triangles[first + k] & 1) != 0 ? inverse_or_zero(d01 * (lv[k] - uv[k]) - (uv[k + 1] - uv[k]) * d10) : 0.0F;
    chunk.inverse_lower[k] =
        (triangles[first + k] & 2) != 0
            ? inverse_or_zero((d10 - d11) * (uv[k + 1] - lv[k + 1]) - (lv[k] - lv[k + 1]) * (d01 - d11))
            : 0.0F;
  }
  return {widest, highest};
}

/// Tests position (step_u, step_v) of every box in the chunk.
inline void test_chunk(const RasterJob& job, const VertexRow& upper, const VertexRow& lower, int row, int first,
                       int count, int step_u, int step_v, Chunk& chunk) {
  const float *uv = upper.v + first, *ud = upper.depth + first;
  const float *lv = lower.v + first, *ld = lower.depth + first;
  const float *begin_across = job.begin_across + first, *span_across = job.span_across + first;
  const float begin_down = job.begin_down[row];
  const float span_down = job.span_down[row];
  for (int k = 0; k < count; ++k) {
    const int u = chunk.left[k] + step_u;
    const int v = chunk.top[k] + step_v;
    const float x = static_cast<float>(u);
    const float y = static_cast<float>(v);
    // Upper left triangle: p = p00 + a (p01 - p00) + b (p10 - p00).
    const float qx = x - chunk.u00[k];
    const float qy = y - uv[k];
    const float a1 = (qx * (lv[k] - uv[k]) - qy * (chunk.u10[k] - chunk.u00[k])) * chunk.inverse_upper[k];
    const float b1 = ((chunk.u01[k] - chunk.u00[k]) * qy - (uv[k + 1] - uv[k]) * qx) * chunk.inverse_upper[k];
    const int in1 = (a1 >= -kSlack ? 1 : 0) & (b1 >= -kSlack ? 1 : 0) & (a1 + b1 <= 1.0F + kSlack ? 1 : 0) &
                    (chunk.inverse_upper[k] != 0.0F ? 1 : 0);
    const float z1 = ud[k] + a1 * (ud[k + 1] - ud[k]) + b1 * (ld[k] - ud[k]);
    // Lower right triangle: p = p11 + a (p10 - p11) + b (p01 - p11).
    const float rx = x - chunk.u11[k];
    const float ry = y - lv[k + 1];
    const float a2 = (rx * (uv[k + 1] - lv[k + 1]) - ry * (chunk.u01[k] - chunk.u11[k])) * chunk.inverse_lower[k];
    const float b2 = ((chunk.u10[k] - chunk.u11[k]) * ry - (lv[k] - lv[k + 1]) * rx) * chunk.inverse_lower[k];
    const int in2 = (a2 >= -kSlack ? 1 : 0) & (b2 >= -kSlack ? 1 : 0) & (a2 + b2 <= 1.0F + kSlack ? 1 : 0) &
                    (chunk.inverse_lower[k] != 0.0F ? 1 : 0);
    const float z2 = ld[k + 1] + a2 * (ld[k] - ld[k + 1]) + b2 * (ud[k + 1] - ld[k + 1]);
    const float a = in1 != 0 ? a1 : 1.0F - a2;
    const float b = in1 != 0 ? b1 : 1.0F - b2;
    chunk.hit_depth[k] = in1 != 0 ? z1 : z2;
    chunk.fraction_x[k] = fraction14(begin_across[k], span_across[k], a);
    chunk.fraction_y[k] = fraction14(begin_down, span_down, b);
    chunk.hit_u[k] = u;
    chunk.hit_v[k] = v;
    chunk.hit[k] = (step_u < chunk.width[k] ? 1 : 0) & (step_v < chunk.height[k] ? 1 : 0) & (in1 | in2);
  }
}

inline void put_chunk(const RasterJob& job, int row, int first, int count, const Chunk& chunk) {
  const auto texel_row = static_cast<std::uint32_t>(job.texel_down[row]) << 16;
  for (int k = 0; k < count; ++k) {
    if (chunk.hit[k] == 0) continue;
    const auto texel = static_cast<std::uint32_t>(job.texel_across[first + k]) | texel_row;
    const auto fraction =
        static_cast<std::uint32_t>(chunk.fraction_x[k]) | (static_cast<std::uint32_t>(chunk.fraction_y[k]) << 16);
    put(job, chunk.hit_u[k], chunk.hit_v[k], chunk.hit_depth[k], texel, fraction);
  }
}

struct Vector {
  float x, y, z;
};
inline Vector operator-(const Vector& a, const Vector& b) { return {a.x - b.x, a.y - b.y, a.z - b.z}; }
inline Vector cross(const Vector& a, const Vector& b) {
  return {a.y * b.z - a.z * b.y, a.z * b.x - a.x * b.z, a.x * b.y - a.y * b.x};
}
inline float dot(const Vector& a, const Vector& b) { return a.x * b.x + a.y * b.y + a.z * b.z; }
inline Vector point(const VertexRow& row, int j) { return {row.px[j], row.py[j], row.pz[j]}; }

/// Triangle corner + a side_a + b side_b, prepared for rays from the origin (Moeller and Trumbore 1997, with all but
/// the ray's direction factored out): a = normal_a . d / n . d, likewise b; the depth is n . corner / n . d.
struct RayTriangle {
  Vector normal, normal_a, normal_b;
  float offset;
};

inline RayTriangle ray_triangle(const Vector& corner, const Vector& end_a, const Vector& end_b) {
  const Vector side_a = end_a - corner;
  const Vector side_b = end_b - corner;
  const Vector normal = cross(side_a, side_b);
  return {normal, cross(side_b, corner), cross(corner, side_a), dot(normal, corner)};
}

/// Draws one triangle over a box of pixels; `flip` as for the lower right triangle, whose corner is 11.
inline void draw_triangle(const RasterJob& job, const RayTriangle& triangle, bool flip, int row, int column, int left,
                          int right, int top, int bottom) {
  const auto texel =
      static_cast<std::uint32_t>(job.texel_across[column]) | (static_cast<std::uint32_t>(job.texel_down[row]) << 16);
  for (int v = top; v <= bottom; ++v) {
    for (int u = left; u <= right; ++u) {
      int c = u;
      if (job.panoramic && c < 0) c += job.width;
      if (job.panoramic && c >= job.width) c -= job.width;
      const Vector d{job.target_ray_x[c] * job.target_ray_m[v], job.target_ray_y[v],
                     job.target_ray_z[c] * job.target_ray_m[v]};
      const float facing = dot(triangle.normal, d);
      if (facing == 0.0F) continue;
      const float inverse = 1.0F / facing;
      float a = dot(triangle.normal_a, d) * inverse;
      float b = dot(triangle.normal_b, d) * inverse;
      const float depth = triangle.offset * inverse;
      if (!(a >= -kSlack && b >= -kSlack && a + b <= 1.0F + kSlack && depth > kNear)) continue;
      if (flip) {
        a = 1.0F - a;
        b = 1.0F - b;
      }
      const int fx = fraction14(job.begin_across[column], job.span_across[column], a);
      const int fy = fraction14(job.begin_down[row], job.span_down[row], b);
      put(job, c, v, depth, texel, static_cast<std::uint32_t>(fx) | (static_cast<std::uint32_t>(fy) << 16));
    }
  }
}

/// Draws a quad that the chunk loops do not take.
inline void draw_large(const RasterJob& job, const VertexRow& upper, const VertexRow& lower, int row, int column,
                       float u01, float u10, float u11) {
  const float u00 = upper.u[column];
  float left = min_of(min_of(u00, u01), min_of(u10, u11));
  float right = max_of(max_of(u00, u01), max_of(u10, u11));
  float top = min_of(min_of(upper.v[column], upper.v[column + 1]), min_of(lower.v[column], lower.v[column + 1]));
  float bottom = max_of(max_of(upper.v[column], upper.v[column + 1]), max_of(lower.v[column], lower.v[column + 1]));
  const auto width = static_cast<float>(job.width);
  const auto height = static_cast<float>(job.height);
  if (job.panoramic) {
    // Great circles bulge towards the pole: by a row at most while the quad spans little longitude, and a quad that
    // spans much of it may hold the pole.
    const bool wide = right - left > 0.2F * width;
    const bool north = top + bottom < height;
    if (north) {
      top = wide ? 0.0F : top - 1.0F;
    } else {
      bottom = wide ? height - 1.0F : bottom + 1.0F;
    }
    if (wide) {
      left = 0.0F;
      right = width - 1.0F;
    }
  } else {
    left = max_of(left, 0.0F);
    right = min_of(right, width - 1.0F);
  }
  const int u0 = ceil_int(left - 1.0e-3F);
  const int u1 = floor_int(right + 1.0e-3F);
  const int v0 = max_of(0, ceil_int(top - 1.0e-3F));
  const int v1 = min_of(job.height - 1, floor_int(bottom + 1.0e-3F));
  const std::uint8_t triangles = job.triangles[static_cast<std::size_t>(row) * (job.columns - 1) + column];
  const Vector p00 = point(upper, column);
  const Vector p01 = point(upper, column + 1);
  const Vector p10 = point(lower, column);
  const Vector p11 = point(lower, column + 1);
  if ((triangles & 1) != 0) draw_triangle(job, ray_triangle(p00, p01, p10), false, row, column, u0, u1, v0, v1);
  if ((triangles & 2) != 0) draw_triangle(job, ray_triangle(p11, p10, p01), true, row, column, u0, u1, v0, v1);
}

inline void draw_row(const RasterJob& job, const VertexRow& upper, const VertexRow& lower, int row, Chunk& chunk) {
  const int quads = job.columns - 1;
  const std::uint8_t* triangles = job.triangles + static_cast<std::size_t>(row) * quads;
  for (int first = 0; first < quads; first += kChunk) {
    const int count = min_of(kChunk, quads - first);
    const Box box = bound_chunk(job, upper, lower, triangles, first, count, chunk);
    for (int step_v = 0; step_v < box.height; ++step_v) {
      for (int step_u = 0; step_u < box.width; ++step_u) {
        test_chunk(job, upper, lower, row, first, count, step_u, step_v, chunk);
        put_chunk(job, row, first, count, chunk);
      }
    }
    for (int k = 0; k < count; ++k) {
      if (chunk.large[k] != 0) {
        draw_large(job, upper, lower, row, first + k, chunk.u01[k], chunk.u10[k], chunk.u11[k]);
      }
    }
  }
}

inline void raster(const RasterJob& job) {
  Chunk chunk;
  VertexRow upper = vertex_row(job.scratch, job.columns);
  VertexRow lower = vertex_row(job.scratch + 6 * static_cast<std::ptrdiff_t>(job.columns), job.columns);
  build_row(job, 0, upper);
  for (int row = 0; row + 1 < job.rows; ++row) {
    build_row(job, row + 1, lower);
    draw_row(job, upper, lower, row, chunk);
    const VertexRow swap = upper;
    upper = lower;
    lower = swap;
  }
}

}  // namespace
}  // namespace wiw::reproject
