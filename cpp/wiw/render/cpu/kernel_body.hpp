// SPDX-License-Identifier: Apache-2.0
#pragma once

/// The ray casting and shading of one tile, written once over the lanes that a simd_*.hpp included before this file
/// defines. Packets are 4 pixels wide and kLanes / 4 high. Masks are Ints of 0 and -1.

#include "wiw/render/cpu/shade.hpp"

namespace wiw::render::cpu {
namespace {

constexpr int kPacketWidth = 4;
constexpr int kPacketHeight = kLanes / kPacketWidth;

inline Ints lane_numbers() {
  Ints lanes;
  for (int lane = 0; lane < kLanes; ++lane) lanes[lane] = lane;
  return lanes;
}

inline Directions directions(const KernelView& view, const RayGrid& grid, int x, int y) {
  const Floats column = columns_of(grid.column + x);
  const Floats row = rows_of(grid.row + y);
  Floats right = column;
  Floats forward = Floats{} + 1.f;
  if (view.panorama) {
    const Floats row_cos = rows_of(grid.row_cos + y);
    right = row_cos * column;
    forward = row_cos * columns_of(grid.column_forward + x);
  }
  return {forward * view.forward[0] + right * view.right[0] + row * view.up[0],
          forward * view.forward[1] + right * view.right[1] + row * view.up[1],
          forward * view.forward[2] + right * view.right[2] + row * view.up[2]};
}

/// What never changes from packet to packet: Embree writes only tfar and the hit.
inline void start_rays(RayHit& rays, const KernelView& view) {
  store(rays.ray.org_x, Floats{} + view.origin[0]);
  store(rays.ray.org_y, Floats{} + view.origin[1]);
  store(rays.ray.org_z, Floats{} + view.origin[2]);
  store(rays.ray.tnear, Floats{} + shading::kNearClip);
  store(rays.ray.time, Floats{});
  store(rays.ray.mask, Ints{} - 1);
  store(rays.ray.id, Ints{});
  store(rays.ray.flags, Ints{});
}

/// Casts the packet through the scene's two parts; the second only replaces nearer hits. Returns the mask of hits.
inline Ints cast(const KernelScene& scene, const Directions& d, Ints valid, RayHit& rays) {
  store(rays.ray.dir_x, without_dust(d.x));
  store(rays.ray.dir_y, without_dust(d.y));
  store(rays.ray.dir_z, without_dust(d.z));
  store(rays.ray.tfar, Floats{} + __builtin_inff());
  store(rays.hit.geomID, Ints{} - 1);
  store(rays.hit.instID[0], Ints{} - 1);
  RTCIntersectContext context;
  rtcInitIntersectContext(&context);
  context.flags = RTC_INTERSECT_CONTEXT_FLAG_COHERENT;
  const ValidLanes traced(valid);
  intersect(traced.lanes, scene.fixed, &context, &rays);
  if (scene.moved != nullptr) intersect(traced.lanes, scene.moved, &context, &rays);
  return (load_ints(rays.hit.geomID) != -1) & valid;
}

/// Number of every lane's triangle record; 0 for lanes without a hit.
inline void find_records(const KernelScene& scene, const RayHit& rays, Ints hit, std::uint32_t* numbers) {
  alignas(64) std::uint32_t mask[kLanes];
  store(mask, hit);
  for (int lane = 0; lane < kLanes; ++lane) {
    const std::uint32_t first = scene.first_record[rays.hit.geomID[lane] & mask[lane]];
    numbers[lane] = (first + rays.hit.primID[lane]) & mask[lane];
  }
}

inline Hits load_hits(const KernelScene& scene, const Directions& d, const RayHit& rays, Ints hit, Floats spread) {
  Hits hits;
  hits.rays = &rays;
  hits.u = load_floats(rays.hit.u);
  hits.v = load_floats(rays.hit.v);
  hits.t = load_floats(rays.ray.tfar);
  hits.nx = load_floats(rays.hit.Ng_x);
  hits.ny = load_floats(rays.hit.Ng_y);
  hits.nz = load_floats(rays.hit.Ng_z);
  hits.d = d;
  hits.spread = spread;
  hits.hit = hit;
  alignas(64) std::uint32_t numbers[kLanes];
  find_records(scene, rays, hit, numbers);
  load_lines(scene.records, numbers, hits.record);
  return hits;
}

inline RgbLanes shade_rays(const KernelScene& scene, const Hits& hits) {
  RgbLanes color{};
  if (mask_bits(~hits.hit) != 0) color = sky(scene, hits.d);
  if (mask_bits(hits.hit) == 0) return color;
  return shade_hits(scene, hits, color);
}

/// The mean of the pixel's colour samples, each clamped as a display would.
inline RgbLanes supersample(const KernelScene& scene, const KernelView& view, int x, int y, Ints valid, RayHit& rays) {
  RgbLanes sum{};
  for (int i = 0; i < view.sample_count; ++i) {
    const RayGrid& grid = view.samples[i];
    const Directions d = directions(view, grid, x, y);
    const Ints hit = cast(scene, d, valid, rays);
    const RgbLanes color = shade_rays(scene, load_hits(scene, d, rays, hit, rows_of(grid.row_spread + y)));
    sum = {sum.r + color.r, sum.g + color.g, sum.b + color.b};
  }
  const float weight = 1.f / static_cast<float>(view.sample_count);
  return {sum.r * weight, sum.g * weight, sum.b * weight};
}

/// Where a packet lies in the image: `columns` of each of its `rows` rows of 4 lanes are inside.
struct PacketPlace {
  std::size_t first;   // pixel index of lane 0
  std::size_t stride;  // image width
  int columns, rows;
};

inline void write_color(const ImageTargets& image, const PacketPlace& place, const RgbLanes& color) {
  const auto byte = [](Floats value) { return __builtin_convertvector(value * 255.f + 0.5f, Ints); };
  const Ints packed = byte(color.r) | (byte(color.g) << 8) | (byte(color.b) << 16);
  alignas(64) std::uint32_t pixels[kLanes];
  __builtin_memcpy(pixels, &packed, sizeof packed);
  for (int row = 0; row < place.rows; ++row) {
    const std::uint32_t* p = pixels + kPacketWidth * row;
    std::uint8_t* out = image.color + 3 * (place.first + static_cast<std::size_t>(row) * place.stride);
    const std::uint64_t first = p[0] | (std::uint64_t{p[1]} << 24) | (std::uint64_t{p[2]} << 48);
    const std::uint32_t last = (p[2] >> 16) | (p[3] << 8);
    if (place.columns == kPacketWidth) {
      __builtin_memcpy(out, &first, sizeof first);
      __builtin_memcpy(out + sizeof first, &last, sizeof last);
    } else {  // at most three pixels
      for (int i = 0; i < 3 * place.columns; ++i) {
        out[i] = static_cast<std::uint8_t>(i < 8 ? first >> (8 * i) : last);
      }
    }
  }
}

template <class Pixels>
inline void write_words(void* target, const PacketPlace& place, Pixels values) {
  alignas(64) std::uint32_t pixels[kLanes];
  __builtin_memcpy(pixels, &values, sizeof values);
  for (int row = 0; row < place.rows; ++row) {
    auto* out = static_cast<std::uint32_t*>(target) + place.first + static_cast<std::size_t>(row) * place.stride;
    if (place.columns == kPacketWidth) {
      __builtin_memcpy(out, pixels + kPacketWidth * row, 4 * kPacketWidth);
    } else {
      __builtin_memcpy(out, pixels + kPacketWidth * row, 4 * static_cast<std::size_t>(place.columns));
    }
  }
}

inline Ints instance_ids(const KernelScene& scene, const RayHit& rays, Ints hit) {
  alignas(64) std::uint32_t numbers[kLanes];
  find_records(scene, rays, hit, numbers);
  for (int lane = 0; lane < kLanes; ++lane) numbers[lane] = scene.records[numbers[lane]].instance;
  return load_ints(numbers) & hit;
}

inline void draw_packet(const KernelScene& scene, const KernelView& view, const ImageTargets& image, int x, int y,
                        RayHit& rays) {
  const int columns = image.width - x < kPacketWidth ? image.width - x : kPacketWidth;
  const int rows = image.height - y < kPacketHeight ? image.height - y : kPacketHeight;
  const auto stride = static_cast<std::size_t>(image.width);
  const PacketPlace place{static_cast<std::size_t>(y) * stride + static_cast<std::size_t>(x), stride, columns, rows};
  const Ints lanes = lane_numbers();
  const Ints valid = ((lanes & 3) < columns) & ((lanes >> 2) < rows);
  const bool one_sample = view.sample_count == 1;
  if (image.depth != nullptr || image.instance != nullptr || one_sample) {
    const Directions d = directions(view, view.center, x, y);
    const Ints hit = cast(scene, d, valid, rays);
    if (image.color != nullptr && one_sample) {
      const Hits hits = load_hits(scene, d, rays, hit, rows_of(view.center.row_spread + y));
      write_color(image, place, shade_rays(scene, hits));
      if (image.instance != nullptr) write_words(image.instance, place, reinterpret_cast<Ints>(hits.record[13]) & hit);
    } else if (image.instance != nullptr) {
      write_words(image.instance, place, instance_ids(scene, rays, hit));
    }
    if (image.depth != nullptr) {
      write_words(image.depth, place, hit ? load_floats(rays.ray.tfar) : Floats{});
    }
  }
  if (image.color != nullptr && !one_sample) write_color(image, place, supersample(scene, view, x, y, valid, rays));
}

inline void draw_tile(const KernelScene& scene, const KernelView& view, const ImageTargets& image, const Tile& tile) {
  alignas(64) RayHit rays;
  start_rays(rays, view);
  for (int y = tile.y; y < tile.y + tile.height; y += kPacketHeight) {
    for (int x = tile.x; x < tile.x + tile.width; x += kPacketWidth) draw_packet(scene, view, image, x, y, rays);
  }
}

}  // namespace
}  // namespace wiw::render::cpu
