// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstddef>
#include <cstdint>

/// What the vectorised kernels read and write: plain data only, because this header is compiled into objects for
/// several instruction sets, where inline functions of the standard library would leak across.

struct RTCSceneTy;

namespace wiw::render::cpu {

constexpr std::uint32_t kNoDetail = 0xFFFFFFFFu;
constexpr int kLevelSlots = 16;  // = shading::kMaxMipLevels, one AVX-512 register of table entries

/// Everything a hit on one triangle needs, in one cache line: kernels load the line of every ray and transpose.
struct alignas(64) TriangleRecord {
  float uv[6];        // texture coordinate at vertex 0, then its differences to vertices 1 and 2
  float light_uv[6];  // same for the lightmap
  std::uint32_t surface;
  std::uint32_t instance;
  float log2_density;    // of the triangle's largest texels per metre; 0 without texture
  std::uint32_t detail;  // index into details, or kNoDetail
};
constexpr int kRecordWords = 16;
static_assert(sizeof(TriangleRecord) == 4 * kRecordWords);

/// What only some triangles need: shading normals (ambient light and sun) and vertex colours.
struct alignas(64) TriangleDetail {
  float normal[9];         // world space at vertex 0, then differences to vertices 1 and 2; zeros: geometric normal
  std::uint32_t color[3];  // RGBA bytes at the vertices
  float bulge;             // metres; 0 without a sun
  std::uint32_t padding[3];
};
static_assert(sizeof(TriangleDetail) == 4 * kRecordWords);

enum class Edge : std::int32_t { kRepeat, kClamp, kMirror };

/// Mip levels in one array. Each level has a border of one texel on every side (repeated, or that of the edge), so that
/// a bilinear footprint is always two pairs of neighbouring texels and needs no wrap arithmetic.
struct SampledTexture {
  const std::uint32_t* texels;  // RGBA bytes
  float width[kLevelSlots];
  float height[kLevelSlots];
  std::int32_t offset[kLevelSlots];  // of the bordered level's first texel
  float last_level;
  Edge edge_u, edge_v;
  bool nearest;  // level 0 is not interpolated
};

struct ShadingSurface {
  float base_color[3];
  const SampledTexture* texture;   // null: none
  const SampledTexture* lightmap;  // null: none
  float base_alpha;
  float alpha_cutoff;  // negative: opaque
  bool emissive;
  bool vertex_colors;
};

struct Sunlight {
  float direction[3];  // unit, towards the sun
  float strength;
  float ambient;
};

struct KernelScene {
  RTCSceneTy* fixed;                  // never null
  RTCSceneTy* moved;                  // null while nothing has moved
  const std::uint32_t* first_record;  // by geometry id
  const TriangleRecord* records;
  const TriangleDetail* details;
  const ShadingSurface* surfaces;
  const Sunlight* sun;  // null: none
  float zenith[3];
  float horizon[3];
};

/// One ray a pixel in the form the kernels step through. Perspective: direction = forward + column[x] * right +
/// row[y] * up. Panorama: direction = row_cos[y] * (column[x] * right + column_forward[x] * forward) + row[y] * up.
/// Arrays are padded to whole packets.
struct RayGrid {
  const float* column;
  const float* column_forward;  // panorama only
  const float* row;
  const float* row_cos;     // panorama only
  const float* row_spread;  // squared pixel width at t = 1, divided by the samples a pixel
};

struct KernelView {
  bool panorama;
  float origin[3];
  float right[3], up[3], forward[3];
  RayGrid center;          // depth, ids, and colour when sample_count is 1
  const RayGrid* samples;  // colour, when sample_count is more than 1
  int sample_count;
};

/// Where the pixels of one image go; null members are not wanted.
struct ImageTargets {
  int height, width;
  std::uint8_t* color;
  float* depth;
  std::uint32_t* instance;
};

struct Tile {
  int x, y, width, height;
};

using TileKernel = void (*)(const KernelScene&, const KernelView&, const ImageTargets&, const Tile&);

void render_tile_scalar(const KernelScene& scene, const KernelView& view, const ImageTargets& image, const Tile& tile);
void render_tile_avx2(const KernelScene& scene, const KernelView& view, const ImageTargets& image, const Tile& tile);
void render_tile_avx512(const KernelScene& scene, const KernelView& view, const ImageTargets& image, const Tile& tile);
/// The same, reading textures by gather instructions.
void render_tile_avx512_gather(const KernelScene& scene, const KernelView& view, const ImageTargets& image,
                               const Tile& tile);

}  // namespace wiw::render::cpu
