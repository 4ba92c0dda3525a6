// SPDX-License-Identifier: Apache-2.0
#include "wiw/apartment/textures.hpp"

#include <cmath>

#include "wiw/core/error.hpp"

namespace wiw::apartment {

namespace {

TexelFn texel_function(Pattern pattern) {
  for (const auto find : {neutral_pattern, coloured_pattern, rug_pattern, picture_pattern}) {
    if (const TexelFn found = find(pattern)) return found;
  }
  throw ArgumentError("texture pattern " + std::to_string(static_cast<int>(pattern)) + " has no function");
}

std::uint8_t to_byte(float value) {
  return static_cast<std::uint8_t>(std::lround(255.f * std::fmin(1.f, std::fmax(0.f, value))));
}

}  // namespace

scene::Texture make_texture(const TextureRequest& request, const std::string& name) {
  const TexelFn texel = texel_function(request.pattern);
  std::vector<std::uint8_t> rgba(4 * request.size.pixels());
  std::size_t at = 0;
  for (int y = 0; y < request.size.height; ++y) {
    for (int x = 0; x < request.size.width; ++x) {
      const Rgb color = texel(request, (static_cast<float>(x) + 0.5f) / static_cast<float>(request.size.width),
                              (static_cast<float>(y) + 0.5f) / static_cast<float>(request.size.height));
      for (int c = 0; c < 3; ++c) rgba[at++] = to_byte(color[c]);
      rgba[at++] = 255;
    }
  }
  return {name, request.size, std::move(rgba)};
}

Rgb mean_linear(const scene::Texture& texture) {
  Rgb sum = Rgb::Zero();
  const std::size_t step = 4 * 37;  // a coprime stride samples enough of the image
  std::size_t count = 0;
  for (std::size_t i = 0; i + 2 < texture.rgba.size(); i += step, ++count) {
    sum += to_linear(Rgb(texture.rgba[i], texture.rgba[i + 1], texture.rgba[i + 2]) / 255.f);
  }
  return sum / static_cast<float>(count);
}

}  // namespace wiw::apartment
