// SPDX-License-Identifier: Apache-2.0
// Plain data only: included by the kernels, which are compiled once per instruction set.
#pragma once

#include <cstddef>
#include <cstdint>

namespace wiw::reproject {

/// Quads drawn at once. Arrays of quads and of vertices are padded so that a whole group can be read anywhere; padding
/// quads have no triangles.
constexpr int kLanes = 16;
constexpr int padded_lanes(int count) { return (count + 2 * kLanes) / kLanes * kLanes; }

/// Loose quads with their own corners 00 01 10 11, each a ray times a depth; see DepthMesh.
struct Fringe {
  int count;
  const float *ray_x[4], *ray_y[4], *ray_z[4], *depth[4];
  const std::uint8_t* triangles;
  const std::uint32_t* texel;
  const float *begin_x, *span_x, *begin_y, *span_y;
};

constexpr int kFringeBlock = 256;

/// A depth mesh and the view it is drawn into. See MeshLayout and DepthMesh for the source's members.
struct RasterJob {
  // Source.
  int rows, columns;
  const float *ray_x, *ray_z, *ray_m, *ray_y;
  const std::uint32_t *texel_across, *texel_down;
  const float *begin_across, *span_across, *begin_down, *span_down;
  const float* depth;
  const std::uint8_t* triangles;  // [rows - 1, padded_lanes(columns)]
  Fringe fringe;
  // Rigid transform from source to target camera, rows of [R | t].
  float transform[12];
  // Target.
  bool panoramic;
  int height, width;
  float focal;  // pixels, pinhole only
  // Per column from -width to 2 width + kLanes, so that boxes may cross the seam; per row.
  const float *target_ray_x, *target_ray_z;
  const float *target_ray_m, *target_ray_y;
  // Room for two rows of vertices or a block of fringe: scratch_floats(columns).
  float* scratch;
  // Results [height, width]: depth (kNothing where no triangle lands), and the texel block and fractions to look up in
  // the source image, laid out as in panorama::BilinearTable.
  float* out_depth;
  std::uint32_t* out_texel;
  std::uint32_t* out_fraction14;
};

constexpr std::size_t scratch_floats(int columns) {
  const std::size_t rows = 12 * static_cast<std::size_t>(padded_lanes(columns)) + 1;
  const std::size_t fringe = std::size_t{24} * kFringeBlock;
  return rows > fringe ? rows : fringe;
}

constexpr float kNothing = 3.0e38F;
/// Set in out_fraction14 where the surface is seen from the side that the source did not see.
constexpr int kBehind = 1 << 15;

/// Draws the mesh with a depth test; out_depth must be filled with kNothing before.
using RasterFunction = void (*)(const RasterJob&);
void raster_scalar(const RasterJob& job);
void raster_avx2(const RasterJob& job);
void raster_avx512(const RasterJob& job);

}  // namespace wiw::reproject
