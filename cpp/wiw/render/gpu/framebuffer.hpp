// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <array>
#include <cstddef>
#include <string>

#include "wiw/core/error.hpp"
#include "wiw/core/image.hpp"
#include "wiw/render/gpu/gl_object.hpp"
#include "wiw/render/gpu/shader_source.hpp"

namespace wiw::render::gpu {

// Colour attachments, in the order of the shaders' output locations.
enum : std::size_t { kColorTarget = 0, kDepthTarget = 1, kIdTarget = 2, kSlopeTarget = 3 };

/// The driver has no memory for what was asked for; less of it may fit.
class OutOfGraphicsMemory : public BackendError {
 public:
  explicit OutOfGraphicsMemory(const std::string& doing)
      : BackendError(doing + ": out of graphics memory; use smaller batches, images, textures or scenes") {}
};

/// Pixels drawn before one read-back (its textures take 12 bytes a pixel), and kept between calls.
inline constexpr std::size_t kBatchPixels = std::size_t{8} << 20;

/// Stack of equal offscreen images, drawn one layer at a time. Every view starts at the same corner, because
/// rasterisers round by position: the same view gives the same pixels wherever it stands in a batch. The textures are
/// made when first needed and kept for requests they are large enough for; beyond kBatchPixels they are no larger than
/// the last request.
class Framebuffer {
 public:
  explicit Framebuffer(const Gl& gl) : gl_(gl) {}

  /// Makes room for `layers` images of `size` (or larger) for the wanted outputs: kColorOut | kDepthOut | kIdOut, and
  /// kCubeFace for the slope of depth. Throws OutOfGraphicsMemory, and then holds nothing. No GL error may be pending.
  void reserve(Size size, int layers, ProgramKey outputs, bool depth_test);

  /// Binds one layer for drawing the outputs that were reserved.
  void bind(int layer, ProgramKey outputs, bool depth_test);

  /// Sets all outputs of the bound layer to zero, and the depth buffer to infinitely far.
  void clear(ProgramKey outputs, bool depth_test) const;

  /// Array texture of one output.
  [[nodiscard]] GLuint texture(std::size_t target) const { return targets_[target].id(); }

  /// Array texture of one layer: what the depth test has left.
  [[nodiscard]] GLuint depth_texture() const { return depth_buffer_.id(); }

  /// Gives all textures back.
  void release();

 private:
  void choose_room(Size size, int layers);
  [[nodiscard]] bool is_complete(ProgramKey outputs, bool depth_test) const;
  void allocate_missing(ProgramKey outputs, bool depth_test);
  void allocate(GlTexture& texture, int layers, GLint internal, GLenum format, GLenum type);

  const Gl& gl_;
  GlFramebuffer framebuffer_;
  std::array<GlTexture, 4> targets_;
  GlTexture depth_buffer_;  // one layer, cleared for each view
  Size size_;
  int layers_ = 0;
};

}  // namespace wiw::render::gpu
