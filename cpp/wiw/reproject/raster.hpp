// SPDX-License-Identifier: Apache-2.0
// Plain data only: included by the kernels, which are compiled once per instruction set.
#pragma once

#include <cstddef>
#include <cstdint>

namespace wiw::reproject {

/// A depth mesh and the view it is drawn into. See MeshLayout and DepthMesh for the source's members.
struct RasterJob {
  // Source.
  int rows, columns;
  const float *ray_x, *ray_z, *ray_m, *ray_y;
  const std::int32_t *texel_across, *texel_down;
  const float *begin_across, *span_across, *begin_down, *span_down;
  const float* depth;
  const std::uint8_t* triangles;
  // Rigid transform from source to target camera, rows of [R | t].
  float transform[12];
  // Target.
  bool panoramic;
  int height, width;
  float focal;  // pixels, pinhole only
  const float *target_ray_x, *target_ray_z, *target_ray_m, *target_ray_y;
  // Room for two rows of vertices: 12 * columns floats.
  float* scratch;
  // Results [height, width]: depth (kNothing where no triangle lands), and the texel block and fractions to look up in
  // the source image, laid out as in panorama::BilinearTable.
  float* out_depth;
  std::uint32_t* out_texel;
  std::uint32_t* out_fraction14;
};

constexpr float kNothing = 3.0e38F;

/// Draws the mesh with a depth test; out_depth must be filled with kNothing before.
using RasterFunction = void (*)(const RasterJob&);
void raster_scalar(const RasterJob& job);
void raster_avx2(const RasterJob& job);
void raster_avx512(const RasterJob& job);

}  // namespace wiw::reproject
