// SPDX-License-Identifier: Apache-2.0
#include "wiw/render/cpu/texture_store.hpp"

#include <algorithm>
#include <cmath>
#include <cstring>

#include "wiw/render/mipmap.hpp"
#include "wiw/render/shading.hpp"

namespace wiw::render::cpu {

static_assert(kLevelSlots == shading::kMaxMipLevels);

namespace {
std::size_t bordered_texels(Size size) {
  return (static_cast<std::size_t>(size.height) + 2) * (static_cast<std::size_t>(size.width) + 2);
}

/// The texel that stands at `i` from -1 to size; beside a mirror stands the edge itself.
int edge_index(int i, int size, Edge edge) {
  if (edge == Edge::kRepeat) return (i + size) % size;
  return std::clamp(i, 0, size - 1);
}

Edge edge_of(scene::Wrap wrap) {
  switch (wrap) {
    case scene::Wrap::kRepeat: return Edge::kRepeat;
    case scene::Wrap::kClamp: return Edge::kClamp;
    case scene::Wrap::kMirror: return Edge::kMirror;
  }
  return Edge::kRepeat;
}

float wrapped(float coordinate, Edge edge) {
  if (edge == Edge::kRepeat) coordinate -= std::floor(coordinate);
  if (edge == Edge::kMirror) {
    coordinate -= 2.f * std::floor(0.5f * coordinate);
    coordinate = coordinate > 1.f ? 2.f - coordinate : coordinate;
  }
  return coordinate > 0.f ? std::min(coordinate, 1.f) : 0.f;  // not-a-number becomes 0
}
}  // namespace

TextureStore::TextureStore(const scene::Texture& texture, Use use) {
  const bool is_lightmap = use == Use::kLightmap;
  sampled_.edge_u = is_lightmap ? Edge::kClamp : edge_of(texture.sampling.u);
  sampled_.edge_v = is_lightmap ? Edge::kClamp : edge_of(texture.sampling.v);
  sampled_.nearest = !is_lightmap && texture.sampling.nearest;
  const auto mips = is_lightmap ? std::vector<MipLevel>{} : build_mips(texture);
  std::size_t total = bordered_texels(texture.size);
  for (const MipLevel& level : mips) total += bordered_texels(level.size);
  texels_.reserve(total);
  add_level(texture.rgba.data(), texture.size, 0);
  for (std::size_t i = 0; i < mips.size(); ++i) {
    add_level(mips[i].rgba.data(), mips[i].size, static_cast<int>(i) + 1);
  }
  sampled_.texels = texels_.data();
  sampled_.last_level = static_cast<float>(mips.size());
}

void TextureStore::add_level(const std::uint8_t* rgba, Size size, int level) {
  sampled_.width[level] = static_cast<float>(size.width);
  sampled_.height[level] = static_cast<float>(size.height);
  sampled_.offset[level] = static_cast<std::int32_t>(texels_.size());
  for (int y = -1; y <= size.height; ++y) {
    const std::uint8_t* row = rgba + 4 * static_cast<std::size_t>(edge_index(y, size.height, sampled_.edge_v)) *
                                         static_cast<std::size_t>(size.width);
    for (int x = -1; x <= size.width; ++x) {
      std::uint32_t texel = 0;
      std::memcpy(&texel, row + 4 * edge_index(x, size.width, sampled_.edge_u), 4);
      texels_.push_back(texel);
    }
  }
}

float sample_alpha(const SampledTexture& texture, float u, float v) {
  const auto place = [&](float coordinate, float size) {
    const float texels = coordinate * size;
    return texture.nearest ? std::min(std::floor(texels), size - 1) + 1 : texels + 0.5f;
  };
  const float x = place(wrapped(u, texture.edge_u), texture.width[0]);
  const float y = place(wrapped(v, texture.edge_v), texture.height[0]);
  const auto column = static_cast<int>(x);
  const auto row = static_cast<int>(y);
  const int stride = static_cast<int>(texture.width[0]) + 2;
  const std::uint32_t* texel = texture.texels + texture.offset[0] + row * stride + column;
  const auto alpha = [](std::uint32_t rgba) { return static_cast<float>(rgba >> 24); };
  const float right = x - static_cast<float>(column);
  const float top = std::lerp(alpha(texel[0]), alpha(texel[1]), right);
  const float bottom = std::lerp(alpha(texel[stride]), alpha(texel[stride + 1]), right);
  return std::lerp(top, bottom, y - static_cast<float>(row)) / 255.f;
}

}  // namespace wiw::render::cpu
