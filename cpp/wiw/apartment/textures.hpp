// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstdint>
#include <vector>

#include "wiw/apartment/color.hpp"
#include "wiw/scene/scene.hpp"

namespace wiw::apartment {

enum class Pattern {
  kNone,
  // Neutral: near white, multiplied with the material's colour.
  kPlaster,
  kGrain,
  kWeave,
  kLeather,
  kBrushed,
  kPlanks,
  kHerringbone,
  kBasketParquet,
  kCarpet,
  kConcrete,
  kWicker,
  // Coloured: `colors` are part of the image.
  kTiles,
  kChecker,
  kHexagons,
  kBricks,
  kMarble,
  kTerrazzo,
  kBoards,
  kStripes,
  kDamask,
  kTrellis,
  kDots,
  kLeaves,
  kRugBorder,
  kRugStripes,
  kRugDiamonds,
  kRugShag,
  kPictureHills,
  kPictureBlocks,
  kPictureCircles,
  kPictureFlower,
  kPictureSkyline,
  kPictureWaves,
  kPictureFruit,
  kKeyboard
};

struct TextureRequest {
  Pattern pattern = Pattern::kNone;
  std::vector<Rgb> colors;
  std::uint32_t variant = 0;
  Size size{256, 256};
  bool operator==(const TextureRequest&) const = default;
};

/// Colour of a texture at (u, v) in [0, 1)^2, v downwards; images of repeating patterns are tileable.
using TexelFn = Rgb (*)(const TextureRequest& request, float u, float v);
TexelFn neutral_pattern(Pattern pattern);
TexelFn coloured_pattern(Pattern pattern);
TexelFn rug_pattern(Pattern pattern);
TexelFn picture_pattern(Pattern pattern);

scene::Texture make_texture(const TextureRequest& request, const std::string& name);
/// Mean linear colour, for light that bounces off.
Rgb mean_linear(const scene::Texture& texture);

}  // namespace wiw::apartment
