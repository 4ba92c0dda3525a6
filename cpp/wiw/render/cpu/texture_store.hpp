// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstdint>
#include <memory>
#include <vector>

#include "wiw/render/cpu/kernel.hpp"
#include "wiw/scene/scene.hpp"

namespace wiw::render::cpu {

/// A texture as the kernels read it, with the texels it points to. Lightmaps are clamped and keep level 0 only.
class TextureStore {
 public:
  enum class Use { kSurface, kLightmap };
  TextureStore(const scene::Texture& texture, Use use);

  [[nodiscard]] const SampledTexture& sampled() const { return sampled_; }

 private:
  void add_level(const std::uint8_t* rgba, Size size, int level);

  std::vector<std::uint32_t> texels_;
  SampledTexture sampled_{};
};

/// Alpha in [0, 1] of level 0, by the same rule as the kernels' colours.
float sample_alpha(const SampledTexture& texture, float u, float v);

}  // namespace wiw::render::cpu
