// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstdint>
#include <memory>
#include <vector>

#include "wiw/render/cpu/kernel.hpp"
#include "wiw/scene/scene.hpp"

namespace wiw::render::cpu {

/// A texture as the kernels read it, with the texels it points to. Clamped textures (lightmaps) keep level 0 only.
class TextureStore {
 public:
  enum class Edge { kRepeat, kClamp };
  TextureStore(const scene::Texture& texture, Edge edge);

  [[nodiscard]] const SampledTexture& sampled() const { return sampled_; }

 private:
  void add_level(const std::uint8_t* rgba, Size size, int level, Edge edge);

  std::vector<std::uint32_t> texels_;
  SampledTexture sampled_{};
};

/// Bilinear alpha in [0, 1] of level 0, by the same rule as the kernels' colours.
float sample_alpha(const SampledTexture& texture, float u, float v);

}  // namespace wiw::render::cpu
