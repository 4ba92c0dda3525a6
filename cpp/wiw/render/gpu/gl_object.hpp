// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <bit>
#include <cstddef>
#include <utility>

#include "wiw/render/gpu/gl_api.hpp"

namespace wiw::render::gpu {

/// Owns one GL name. Create and destroy only while the context is current.
template <auto Generate, auto Delete>
class GlObject {
 public:
  GlObject() = default;
  explicit GlObject(const Gl& gl) : gl_(&gl) { (gl.*Generate)(1, &id_); }
  ~GlObject() {
    if (id_ != 0) (gl_->*Delete)(1, &id_);
  }
  GlObject(GlObject&& other) noexcept : gl_(other.gl_), id_(std::exchange(other.id_, 0)) {}
  GlObject& operator=(GlObject&& other) noexcept {
    std::swap(gl_, other.gl_);
    std::swap(id_, other.id_);
    return *this;
  }

  [[nodiscard]] GLuint id() const { return id_; }

 private:
  const Gl* gl_ = nullptr;
  GLuint id_ = 0;
};

/// GL passes a position inside the bound buffer as a pointer.
inline void* buffer_offset(std::size_t bytes) { return std::bit_cast<void*>(bytes); }

using GlBuffer = GlObject<&Gl::GenBuffers, &Gl::DeleteBuffers>;
using GlTexture = GlObject<&Gl::GenTextures, &Gl::DeleteTextures>;
using GlSampler = GlObject<&Gl::GenSamplers, &Gl::DeleteSamplers>;
using GlVertexArray = GlObject<&Gl::GenVertexArrays, &Gl::DeleteVertexArrays>;
using GlFramebuffer = GlObject<&Gl::GenFramebuffers, &Gl::DeleteFramebuffers>;

}  // namespace wiw::render::gpu
