// SPDX-License-Identifier: Apache-2.0
#include "wiw/reproject/warp.hpp"

#include <algorithm>
#include <numeric>
#include <string>

#include "wiw/core/error.hpp"
#include "wiw/core/thread_pool.hpp"
#include "wiw/panorama/remap.hpp"
#include "wiw/reproject/fill.hpp"
#include "wiw/reproject/raster.hpp"

namespace wiw::reproject {

namespace {

RasterFunction raster_function(Isa isa) {
#if defined(__x86_64__)
  if (isa == Isa::kAvx512) return raster_avx512;
  if (isa == Isa::kAvx2) return raster_avx2;
#endif
  return raster_scalar;
}

/// begin, begin + 1, ... end - 1.
std::vector<double> indices(int begin, int end) {
  std::vector<double> values(static_cast<std::size_t>(end - begin));
  std::iota(values.begin(), values.end(), static_cast<double>(begin));
  return values;
}

/// Working memory of one frame, kept by each thread: fresh pages would cost as much as the drawing.
struct Scratch {
  std::vector<float> vertices;
  std::vector<float> depth;
  std::vector<std::uint32_t> texel;
  std::vector<std::uint32_t> fraction14;
  std::vector<std::uint8_t> color;
};

Scratch& scratch_for(std::size_t pixels, int columns) {
  thread_local Scratch scratch;
  scratch.vertices.resize(scratch_floats(columns));
  scratch.depth.assign(pixels, kNothing);
  scratch.texel.assign(pixels, 0);
  scratch.fraction14.assign(pixels, 0);
  scratch.color.resize(3 * pixels);
  return scratch;
}

Fringe fringe_of(const DepthMesh& mesh) {
  const FringeQuads& quads = mesh.fringe;
  Fringe fringe{};
  fringe.count = quads.count;
  for (int corner = 0; corner < 4; ++corner) {
    fringe.ray_x[corner] = quads.ray_x[corner].data();
    fringe.ray_y[corner] = quads.ray_y[corner].data();
    fringe.ray_z[corner] = quads.ray_z[corner].data();
    fringe.depth[corner] = quads.depth[corner].data();
  }
  fringe.triangles = quads.triangles.data();
  fringe.texel = quads.texel.data();
  fringe.begin_x = quads.begin_x.data();
  fringe.span_x = quads.span_x.data();
  fringe.begin_y = quads.begin_y.data();
  fringe.span_y = quads.span_y.data();
  return fringe;
}

/// Makes holes of surfaces seen from behind: they hide what is there, but the source saw their other side.
void forget_behind(Scratch& scratch) {
  for (std::size_t i = 0; i < scratch.depth.size(); ++i) {
    if ((scratch.fraction14[i] & kBehind) == 0) continue;
    scratch.depth[i] = kNothing;
    scratch.texel[i] = 0;
    scratch.fraction14[i] = 0;
  }
}

/// Whether the source texel nearest to a sample has no depth. Holes read texel 0 and are not sky for that.
bool saw_sky(std::uint32_t texel, std::uint32_t fraction14, const float* depth, const Size& size) {
  if (texel == 0 && fraction14 == 0) return false;
  const std::uint32_t half = 1u << (panorama::kWeightBits - 1);
  const std::uint32_t column = (texel & 0xFFFFu) + ((fraction14 & 0xFFFFu) >= half ? 1 : 0);
  const std::uint32_t row = (texel >> 16) + ((fraction14 >> 16) >= half ? 1 : 0);
  const auto width = static_cast<std::uint32_t>(size.width);
  const float seen = depth[static_cast<std::size_t>(row) * width + (column < width ? column : 0)];
  return !(seen > 0.0F && seen < kFar);
}

View checked(const View& view, const char* name) {
  check_view(view, name);
  return view;
}

}  // namespace

Warp::Warp(const View& source, const View& target, float cut)
    : layout_(checked(source, "source")),
      target_(checked(target, "target")),
      target_rays_(make_rays(target_, indices(-target_.size.width, 2 * target_.size.width + kLanes),
                             indices(0, target_.size.height))),
      cut_(cut) {
  if (!(cut > 0.0F)) throw ArgumentError("cut: expected a positive fraction, got " + std::to_string(cut));
}

void Warp::warp_one(const std::uint8_t* color, const float* depth, const DepthMesh& mesh, const Pose& T_source_target,
                    std::size_t frame, const WarpTargets& out, Isa isa) const {
  const std::size_t pixels = target_.size.pixels();
  Scratch& scratch = scratch_for(pixels, layout_.columns);
  const Pose T_target_source = T_source_target.inverse();
  const double focal = target_.panoramic ? 0.0 : Intrinsics{target_.size, target_.hfov}.focal();
  RasterJob job{layout_.rows,
                layout_.columns,
                layout_.rays.x.data(),
                layout_.rays.z.data(),
                layout_.rays.m.data(),
                layout_.rays.y.data(),
                layout_.across.texel.data(),
                layout_.down.texel.data(),
                layout_.across.begin.data(),
                layout_.across.span.data(),
                layout_.down.begin.data(),
                layout_.down.span.data(),
                mesh.depth.data(),
                mesh.triangles.data(),
                fringe_of(mesh),
                {},
                target_.panoramic,
                target_.size.height,
                target_.size.width,
                static_cast<float>(focal),
                target_rays_.x.data() + target_.size.width,
                target_rays_.z.data() + target_.size.width,
                target_rays_.m.data(),
                target_rays_.y.data(),
                scratch.vertices.data(),
                scratch.depth.data(),
                scratch.texel.data(),
                scratch.fraction14.data()};
  for (int row = 0; row < 3; ++row) {
    for (int column = 0; column < 4; ++column) {
      job.transform[4 * row + column] = static_cast<float>(T_target_source.matrix()(row, column));
    }
  }
  raster_function(isa)(job);
  forget_behind(scratch);
  if (out.hole != nullptr) {
    std::transform(scratch.depth.begin(), scratch.depth.end(), out.hole + frame * pixels,
                   [](float d) { return static_cast<std::uint8_t>(d == kNothing ? 1 : 0); });
  }
  std::uint8_t* to = out.color != nullptr ? out.color + 3 * frame * pixels : scratch.color.data();
  panorama::remap_blocks({color, layout_.view.size, 3}, scratch.texel, scratch.fraction14, to, isa);
  fill_holes({to, target_.size, 3}, {scratch.depth.data(), target_.size, 1}, target_.panoramic);
  if (out.depth != nullptr) {
    for (std::size_t i = 0; i < pixels; ++i) {
      const bool sky = saw_sky(scratch.texel[i], scratch.fraction14[i], depth, layout_.view.size);
      out.depth[frame * pixels + i] = sky || scratch.depth[i] >= 0.5F * kFar ? 0.0F : scratch.depth[i];
    }
  }
}

void Warp::operator()(const std::uint8_t* color, const float* depth, std::size_t sources,
                      std::span<const Pose> T_source_target, const WarpTargets& out, Isa isa) const {
  if (sources == 0) return;
  const std::size_t poses = T_source_target.size() / sources;
  if (poses * sources != T_source_target.size()) {
    throw ArgumentError("warp: expected poses [B, T] for B = " + std::to_string(sources) + " sources, got " +
                        std::to_string(T_source_target.size()) + " poses");
  }
  const std::size_t pixels = layout_.view.size.pixels();
  std::vector<DepthMesh> meshes(sources);
  parallel_for(sources, [&](std::size_t b) { meshes[b] = build_mesh(layout_, depth + b * pixels, cut_); });
  parallel_for(T_source_target.size(), [&](std::size_t frame) {
    const std::size_t b = frame / poses;
    warp_one(color + 3 * b * pixels, depth + b * pixels, meshes[b], T_source_target[frame], frame, out, isa);
  });
}

}  // namespace wiw::reproject
