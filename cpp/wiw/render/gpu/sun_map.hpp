// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <array>
#include <vector>

#include "wiw/render/gpu/framebuffer.hpp"
#include "wiw/render/gpu/geometry.hpp"
#include "wiw/render/gpu/gl_context.hpp"
#include "wiw/render/gpu/uniform_slots.hpp"
#include "wiw/render/gpu/view.hpp"

namespace wiw::render::gpu {

/// The map is two squares: one over the whole scene, and a finer one over everything but what spans most of it, such as
/// a ground. A shadow lies right behind what casts it, so the finer square has the shadows of all small things.
constexpr std::size_t kSunSquares = 2;
constexpr int kSunSide = 2048;  // texels of a square

/// The shaders' uniform block `Sun` (std140): the frames of the squares, and the light.
struct SunBlock {
  Eigen::Vector4f right = Eigen::Vector4f::Zero();
  Eigen::Vector4f up = Eigen::Vector4f::Zero();
  Eigen::Vector4f direction = Eigen::Vector4f::Zero();  // towards the sun
  std::array<Eigen::Vector4f, kSunSquares> corner;      // of each square's first texel, at height 0
  std::array<Eigen::Vector4f, kSunSquares> grid;        // metres a texel across and along, range of heights, texels
  Eigen::Vector4f light = Eigen::Vector4f::Zero();      // ambient share, strength
};
static_assert(sizeof(SunBlock) == 8 * 16);

/// The frames of squares of `side` texels that hold all instances, and the small ones.
SunBlock sun_block(const scene::Sun& sun, const scene::Scene& scene, const std::vector<MeshRange>& meshes,
                   const std::vector<Eigen::Affine3f>& poses, int side);

/// The view to draw a square with (kParallel): heights over the scene's lowest point, in [0, 1].
ViewBlock sun_view(const SunBlock& block, std::size_t square);

/// Depths along the sun's direction. Make, use and destroy while the context is current.
class SunMap {
 public:
  SunMap(GlContext& context, const scene::Sun& sun);

  /// Fits the map to the scene and clears it.
  void begin(const scene::Scene& scene, const std::vector<MeshRange>& meshes,
             const std::vector<Eigen::Affine3f>& poses);
  /// What is drawn next with kParallel goes into this square.
  void begin_square(std::size_t square) const;
  /// For the programs that light surfaces.
  void bind() const;

 private:
  GlContext& context_;
  scene::Sun sun_;
  Framebuffer target_;
  UniformSlots<SunBlock> block_;
  UniformSlots<ViewBlock> views_;
};

}  // namespace wiw::render::gpu
