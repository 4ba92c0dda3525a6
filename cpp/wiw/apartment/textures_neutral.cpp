// SPDX-License-Identifier: Apache-2.0
// Patterns that modulate a material's own colour.
#include <array>

#include "wiw/apartment/noise.hpp"
#include "wiw/apartment/textures.hpp"

namespace wiw::apartment {

namespace {

Rgb grey(float value) { return Rgb::Constant(value); }

Rgb plaster(const TextureRequest& t, float u, float v) {
  return grey(0.965f + 0.035f * fractal(u, v, 24, 24, 3, t.variant) - 0.02f * fractal(u, v, 3, 3, 2, t.variant + 9));
}

/// Wood: long streaks along u, warped by slow waves, with fine dark pores.
float wood(float u, float v, int length_cells, int width_cells, std::uint32_t seed) {
  const float warp = fractal(u, v, 2, 3, 2, seed + 3) - 0.5f;
  const float w = v + 0.06f * warp;
  const float rings = 0.5f + 0.5f * std::sin(6.2831853f * (static_cast<float>(width_cells) * (w - std::floor(w)) +
                                                           2.5f * fractal(u, v, length_cells, 4, 2, seed)));
  const float streak = fractal(u, v, length_cells, width_cells * 8, 2, seed + 5);
  const float pores = smooth(0.72f, 0.95f, noise(u * 24.f, v * 160.f, 24, 160, seed + 7));
  return 1.f - 0.09f * rings * rings - 0.13f * (1.f - streak) - 0.08f * pores;
}

Rgb warm(float value) {  // dark grain is redder than the board
  return {std::pow(value, 0.85f), value, std::pow(value, 1.15f)};
}

Rgb grain(const TextureRequest& t, float u, float v) { return warm(wood(u, v, 2, 6, t.variant)); }

/// One floor board: its own tone and stretch of grain, dark joints; x along the board, both in board units.
Rgb board(int id_x, int id_y, float along, float across, float joint_along, float joint_across, std::uint32_t seed) {
  const float tone = 0.84f + 0.16f * hash_unit(id_x, id_y, seed);
  const float shift = hash_unit(id_x, id_y, seed + 1);
  const float value =
      tone * wood(0.37f * along + shift, 0.12f * across + 3.7f * shift - std::floor(3.7f * shift), 3, 7, seed + 2);
  const float edge =
      std::min(std::min(along, 1.f - along) / joint_along, std::min(across, 1.f - across) / joint_across);
  return warm(value) * (0.55f + 0.45f * smooth(0.35f, 1.f, edge));
}

/// Eight rows of long boards with staggered ends: 2.4 m x 1.2 m.
Rgb planks(const TextureRequest& t, float u, float v) {
  constexpr int kRows = 8;
  const int row = static_cast<int>(v * kRows);
  const float stagger = hash_unit(row, 0, t.variant + 11);
  const float x = 2.f * (u + stagger - std::floor(u + stagger));
  const int column = static_cast<int>(x) % 2;
  return board(column, row, x - std::floor(x), v * kRows - static_cast<float>(row), 0.004f, 0.03f, t.variant);
}

/// Blocks of 1 x 4 units laid in zigzag; the image is 16 units wide.
Rgb herringbone(const TextureRequest& t, float u, float v) {
  constexpr int kLong = 4, kUnits = 16;
  const float x = u * kUnits, y = v * kUnits;
  const int i = static_cast<int>(x), j = static_cast<int>(y);
  const float fx = x - static_cast<float>(i), fy = y - static_cast<float>(j);
  const int d = wrap(i - j, 2 * kLong);
  if (d < kLong)
    return board(wrap(i - d, kUnits), j, (static_cast<float>(d) + fx) / kLong, fy, 0.012f, 0.045f, t.variant);
  const int e = 2 * kLong - 1 - d;
  return board(i, wrap(j - e, kUnits) + 64, (static_cast<float>(e) + fy) / kLong, fx, 0.012f, 0.045f, t.variant);
}

/// Squares of five strips, turned in a chessboard.
Rgb basket(const TextureRequest& t, float u, float v) {
  constexpr int kSquares = 4, kStrips = 5;
  float x = u * kSquares, y = v * kSquares;
  const int i = static_cast<int>(x), j = static_cast<int>(y);
  x -= static_cast<float>(i), y -= static_cast<float>(j);
  if ((i + j) % 2 == 1) std::swap(x, y);
  const int strip = static_cast<int>(y * kStrips);
  return board(i * 8 + strip, j, x, y * kStrips - static_cast<float>(strip), 0.012f, 0.05f, t.variant);
}

Rgb weave(const TextureRequest& t, float u, float v) {
  constexpr int kThreads = 48;
  const float x = u * kThreads, y = v * kThreads;
  const int i = static_cast<int>(x), j = static_cast<int>(y);
  const bool over = (i + j) % 2 == 0;
  const float across = over ? y - static_cast<float>(j) : x - static_cast<float>(i);
  const float thread = 1.f - 0.22f * std::pow(std::fabs(2.f * across - 1.f), 2.f);
  const float fleck =
      0.07f * hash_unit(over ? -1 : i, over ? j : -1, t.variant) + 0.05f * fractal(u, v, 8, 8, 3, t.variant + 2);
  return grey(thread - fleck);
}

Rgb leather(const TextureRequest& t, float u, float v) {
  const float folds = fractal(u, v, 20, 20, 3, t.variant);
  const float ridge = 1.f - std::fabs(2.f * folds - 1.f);
  return grey(0.98f - 0.16f * smooth(0.8f, 1.f, ridge) - 0.08f * fractal(u, v, 4, 4, 2, t.variant + 4));
}

Rgb brushed(const TextureRequest& t, float u, float v) {
  return grey(0.88f + 0.08f * noise(u * 4.f, v * 128.f, 4, 128, t.variant) +
              0.06f * std::sin(6.2831853f * (u + 0.3f * std::sin(6.2831853f * v))));
}

Rgb carpet(const TextureRequest& t, float u, float v) {
  const float tuft = hash_unit(static_cast<int>(u * 256.f), static_cast<int>(v * 256.f), t.variant);
  return grey(0.82f + 0.1f * tuft + 0.1f * fractal(u, v, 6, 6, 4, t.variant + 1));
}

Rgb concrete(const TextureRequest& t, float u, float v) {
  const float cloud = fractal(u, v, 4, 4, 5, t.variant);
  const float pit = smooth(0.9f, 0.97f, noise(u * 90.f, v * 90.f, 90, 90, t.variant + 8));
  return grey(0.84f + 0.2f * (cloud - 0.35f) - 0.12f * pit);
}

Rgb wicker(const TextureRequest& t, float u, float v) {
  constexpr int kCanes = 16;
  const float x = u * kCanes, y = v * 2 * kCanes;
  const int i = static_cast<int>(x), j = static_cast<int>(y);
  const float bump =
      std::sin(3.14159265f * (x - static_cast<float>(i))) * std::sin(3.14159265f * (y - static_cast<float>(j)));
  const float tone = 0.8f + 0.2f * hash_unit(i + j, j, t.variant);
  return grey(tone * (((i + j) % 2 == 0) ? 0.55f + 0.45f * bump : 0.5f + 0.3f * bump));
}

}  // namespace

TexelFn neutral_pattern(Pattern pattern) {
  switch (pattern) {
    case Pattern::kPlaster: return plaster;
    case Pattern::kGrain: return grain;
    case Pattern::kWeave: return weave;
    case Pattern::kLeather: return leather;
    case Pattern::kBrushed: return brushed;
    case Pattern::kPlanks: return planks;
    case Pattern::kHerringbone: return herringbone;
    case Pattern::kBasketParquet: return basket;
    case Pattern::kCarpet: return carpet;
    case Pattern::kConcrete: return concrete;
    case Pattern::kWicker: return wicker;
    default: return nullptr;
  }
}

}  // namespace wiw::apartment
