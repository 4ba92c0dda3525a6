// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <array>

#include "wiw/core/image.hpp"
#include "wiw/render/gpu/gl_object.hpp"
#include "wiw/render/gpu/shader_source.hpp"

namespace wiw::gpu {

// Colour attachments, in the order of the shaders' output locations.
enum : std::size_t { kColorTarget = 0, kDepthTarget = 1, kIdTarget = 2, kSlopeTarget = 3 };

/// Stack of equal offscreen images, drawn one layer at a time. Every view starts at the same corner, because
/// rasterisers round by position: the same view gives the same pixels wherever it stands in a batch. The textures are
/// made when first needed and grow to the largest size and number asked for.
class Framebuffer {
 public:
  explicit Framebuffer(const Gl& gl) : gl_(gl) {}

  /// Makes room for `layers` images of `size` (or larger) for the wanted outputs: kColorOut | kDepthOut | kIdOut, and
  /// kCubeFace for the slope of depth.
  void reserve(Size size, int layers, ProgramKey outputs, bool depth_test);

  /// Binds one layer for drawing the outputs that were reserved.
  void bind(int layer, ProgramKey outputs, bool depth_test);

  /// Sets all outputs of the bound layer to zero, and the depth buffer to infinitely far.
  void clear(ProgramKey outputs, bool depth_test) const;

  /// Array texture of one output.
  [[nodiscard]] GLuint texture(std::size_t target) const { return targets_[target].id(); }

 private:
  void allocate(GlTexture& texture, int layers, GLint internal, GLenum format, GLenum type);

  const Gl& gl_;
  GlFramebuffer framebuffer_;
  std::array<GlTexture, 4> targets_;
  GlTexture depth_buffer_;  // one layer, cleared for each view
  Size size_;
  int layers_ = 0;
};

}  // namespace wiw::gpu
