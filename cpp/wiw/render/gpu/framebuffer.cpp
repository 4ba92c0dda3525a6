// SPDX-License-Identifier: Apache-2.0
#include "wiw/render/gpu/framebuffer.hpp"

#include <algorithm>
#include <string>

#include "wiw/core/error.hpp"

namespace wiw::render::gpu {

namespace {

struct TargetFormat {
  GLint internal;
  GLenum format;
  GLenum type;
};
constexpr std::array<TargetFormat, 4> kFormats{{{GL_RGBA8, GL_RGBA, GL_UNSIGNED_BYTE},
                                                {GL_R32F, GL_RED, GL_FLOAT},
                                                {GL_R32UI, GL_RED_INTEGER, GL_UNSIGNED_INT},
                                                {GL_RG32F, GL_RG, GL_FLOAT}}};

bool wants(ProgramKey outputs, std::size_t target) {
  if (target == kSlopeTarget) return (outputs & kCubeFace) != 0 && (outputs & kDepthOut) != 0;
  return (outputs & (kColorOut << target)) != 0;
}

}  // namespace

void Framebuffer::allocate(GlTexture& texture, int layers, GLint internal, GLenum format, GLenum type) {
  texture = GlTexture(gl_);
  gl_.BindTexture(GL_TEXTURE_2D_ARRAY, texture.id());
  gl_.TexImage3D(GL_TEXTURE_2D_ARRAY, 0, internal, size_.width, size_.height, layers, 0, format, type, nullptr);
  gl_.TexParameteri(GL_TEXTURE_2D_ARRAY, GL_TEXTURE_MIN_FILTER, GL_NEAREST);
  gl_.TexParameteri(GL_TEXTURE_2D_ARRAY, GL_TEXTURE_MAG_FILTER, GL_NEAREST);
}

void Framebuffer::release() {
  framebuffer_ = {};
  for (GlTexture& target : targets_) target = {};
  depth_buffer_ = {};
  size_ = {};
  layers_ = 0;
}

/// Grows every axis by itself, so that alternating requests share one room, as long as that stays small.
void Framebuffer::choose_room(Size size, int layers) {
  const auto pixels = [](Size each, int count) { return each.pixels() * static_cast<std::size_t>(count); };
  Size room{std::max(size.height, size_.height), std::max(size.width, size_.width)};
  int deep = std::max(layers, layers_);
  if (pixels(room, deep) > std::max(pixels(size, layers), kBatchPixels)) {
    room = size;
    deep = layers;
  }
  if (room == size_ && deep == layers_) return;
  release();
  size_ = room;
  layers_ = deep;
}

bool Framebuffer::is_complete(ProgramKey outputs, bool depth_test) const {
  bool complete = framebuffer_.id() != 0 && (!depth_test || depth_buffer_.id() != 0);
  for (std::size_t i = 0; i < targets_.size(); ++i)
    complete = complete && (!wants(outputs, i) || targets_[i].id() != 0);
  return complete;
}

void Framebuffer::allocate_missing(ProgramKey outputs, bool depth_test) {
  if (framebuffer_.id() == 0) framebuffer_ = GlFramebuffer(gl_);
  gl_.ActiveTexture(GL_TEXTURE0);
  for (std::size_t i = 0; i < targets_.size(); ++i) {
    if (!wants(outputs, i) || targets_[i].id() != 0) continue;
    allocate(targets_[i], layers_, kFormats[i].internal, kFormats[i].format, kFormats[i].type);
  }
  if (depth_test && depth_buffer_.id() == 0) {
    allocate(depth_buffer_, 1, GL_DEPTH_COMPONENT32F, GL_DEPTH_COMPONENT, GL_FLOAT);
  }
}

void Framebuffer::reserve(Size size, int layers, ProgramKey outputs, bool depth_test) {
  choose_room(size, layers);
  if (is_complete(outputs, depth_test)) return;
  allocate_missing(outputs, depth_test);
  if (gl_.GetError() == GL_NO_ERROR) return;
  const bool larger = size_ != size || layers_ != layers;
  release();
  if (larger) {
    reserve(size, layers, outputs, depth_test);
    return;
  }
  throw OutOfGraphicsMemory("making " + std::to_string(layers) + " targets of " + std::to_string(size.height) + " x " +
                            std::to_string(size.width));
}

void Framebuffer::bind(int layer, ProgramKey outputs, bool depth_test) {
  gl_.BindFramebuffer(GL_FRAMEBUFFER, framebuffer_.id());
  std::array<GLenum, 4> buffers{};
  for (std::size_t i = 0; i < targets_.size(); ++i) {
    const GLenum attachment = GL_COLOR_ATTACHMENT0 + static_cast<GLenum>(i);
    buffers[i] = wants(outputs, i) ? attachment : GL_NONE;
    gl_.FramebufferTextureLayer(GL_FRAMEBUFFER, attachment, wants(outputs, i) ? targets_[i].id() : 0, 0, layer);
  }
  gl_.FramebufferTextureLayer(GL_FRAMEBUFFER, GL_DEPTH_ATTACHMENT, depth_test ? depth_buffer_.id() : 0, 0, 0);
  gl_.DrawBuffers(static_cast<GLsizei>(buffers.size()), buffers.data());
  // Before OpenGL 4.1 a target without colours is incomplete while one is to be read.
  if (outputs == 0) gl_.ReadBuffer(GL_NONE);
  if (gl_.CheckFramebufferStatus(GL_FRAMEBUFFER) != GL_FRAMEBUFFER_COMPLETE) {
    throw BackendError("the OpenGL driver cannot draw into targets of " + std::to_string(size_.height) + " x " +
                       std::to_string(size_.width) + "; use smaller images or backend=\"cpu\"");
  }
}

void Framebuffer::clear(ProgramKey outputs, bool depth_test) const {
  static constexpr std::array<float, 4> kZero{};
  static constexpr std::array<GLuint, 4> kNoId{};
  for (std::size_t i = 0; i < targets_.size(); ++i) {
    if (!wants(outputs, i)) continue;
    if (i == kIdTarget) {
      gl_.ClearBufferuiv(GL_COLOR, static_cast<GLint>(i), kNoId.data());
    } else {
      gl_.ClearBufferfv(GL_COLOR, static_cast<GLint>(i), kZero.data());
    }
  }
  if (depth_test) gl_.ClearBufferfv(GL_DEPTH, 0, kZero.data());
}

}  // namespace wiw::render::gpu
