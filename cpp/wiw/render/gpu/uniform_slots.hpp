// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstddef>
#include <cstring>
#include <span>
#include <vector>

#include "wiw/render/gpu/gl_object.hpp"

namespace wiw::render::gpu {

/// Uniform buffer that holds an array of one std140 block, each at the alignment the driver wants.
template <class Block>
class UniformSlots {
 public:
  UniformSlots(const Gl& gl, int alignment) : gl_(gl), buffer_(gl), stride_(round_up(sizeof(Block), alignment)) {}

  void upload(std::span<const Block> blocks, GLenum usage) {
    std::vector<std::byte> bytes(stride_ * blocks.size());
    for (std::size_t i = 0; i < blocks.size(); ++i) {
      // NOLINTNEXTLINE(bugprone-undefined-memory-manipulation): Eigen's fixed-size vectors are plain floats
      std::memcpy(bytes.data() + i * stride_, &blocks[i], sizeof(Block));
    }
    gl_.BindBuffer(GL_UNIFORM_BUFFER, buffer_.id());
    gl_.BufferData(GL_UNIFORM_BUFFER, static_cast<GLsizeiptr>(bytes.size()), bytes.data(), usage);
  }
  void replace(std::size_t slot, const Block& block) {
    gl_.BindBuffer(GL_UNIFORM_BUFFER, buffer_.id());
    gl_.BufferSubData(GL_UNIFORM_BUFFER, static_cast<GLintptr>(slot * stride_), sizeof(Block), &block);
  }
  void bind(GLuint binding, std::size_t slot) const {
    gl_.BindBufferRange(GL_UNIFORM_BUFFER, binding, buffer_.id(), static_cast<GLintptr>(slot * stride_), sizeof(Block));
  }

 private:
  static std::size_t round_up(std::size_t size, int alignment) {
    const auto step = static_cast<std::size_t>(alignment);
    return (size + step - 1) / step * step;
  }

  const Gl& gl_;
  GlBuffer buffer_;
  std::size_t stride_;
};

}  // namespace wiw::render::gpu
