// SPDX-License-Identifier: Apache-2.0
// Wall and floor coverings of two or more colours, and rugs.
#include <array>

#include "wiw/apartment/noise.hpp"
#include "wiw/apartment/textures.hpp"

namespace wiw::apartment {

namespace {

constexpr float kTurn = 6.2831853f;

Rgb mix(const Rgb& a, const Rgb& b, float t) { return a + t * (b - a); }
float fraction(float x) { return x - std::floor(x); }
/// Distance to the nearest cell border, in cells.
float border(float fx, float fy) { return std::min(std::min(fx, 1.f - fx), std::min(fy, 1.f - fy)); }

/// Square tiles with slight differences in tone and joints in the second colour; 4 x 4 an image.
Rgb tiles(const TextureRequest& t, float u, float v) {
  const float x = 4.f * u, y = 4.f * v;
  const int i = static_cast<int>(x), j = static_cast<int>(y);
  const float tone = 0.94f + 0.06f * hash_unit(i, j, t.variant) - 0.05f * fractal(u, v, 12, 12, 3, t.variant + 3);
  return mix(t.colors[1], tone * t.colors[0], smooth(0.012f, 0.024f, border(fraction(x), fraction(y))));
}

Rgb checker(const TextureRequest& t, float u, float v) {
  const float x = 4.f * u, y = 4.f * v;
  const int i = static_cast<int>(x), j = static_cast<int>(y);
  const float tone = 0.95f + 0.05f * hash_unit(i, j, t.variant) - 0.07f * fractal(u, v, 8, 8, 4, t.variant + 3);
  const Rgb joint = 0.6f * (t.colors[0] + t.colors[1]) * 0.5f;
  return mix(joint, tone * t.colors[static_cast<std::size_t>((i + j) % 2)],
             smooth(0.006f, 0.016f, border(fraction(x), fraction(y))));
}

/// Hexagons: 8 columns by 8 half rows an image (drawn a little out of proportion so that they repeat).
Rgb hexagons(const TextureRequest& t, float u, float v) {
  const float x = 6.f * u, y = 6.f * v;
  float best = 1e9f, second = 1e9f;
  int id = 0;
  for (int j = static_cast<int>(std::floor(y)) - 1; j <= static_cast<int>(std::floor(y)) + 2; ++j) {
    for (int i = static_cast<int>(std::floor(x)) - 1; i <= static_cast<int>(std::floor(x)) + 2; ++i) {
      const float cx = static_cast<float>(i) + (wrap(j, 2) == 1 ? 0.5f : 0.f), cy = static_cast<float>(j);
      const float d = std::hypot(x - cx, 0.87f * (y - cy));
      if (d < best)
        second = best, best = d, id = wrap(i, 6) + 8 * wrap(j, 6);
      else if (d < second)
        second = d;
    }
  }
  const Rgb& face = t.colors[hash_unit(id, 1, t.variant) < 0.2f && t.colors.size() > 2 ? 2 : 0];
  const float tone = 0.94f + 0.06f * hash_unit(id, 0, t.variant);
  return mix(t.colors[1], tone * face, smooth(0.03f, 0.06f, second - best));
}

/// Running bond of bricks or metro tiles; 4 columns by 12 rows an image.
Rgb bricks(const TextureRequest& t, float u, float v) {
  const float y = 12.f * v;
  const int j = static_cast<int>(y);
  const float x = 4.f * u + (j % 2 == 1 ? 0.5f : 0.f);
  const int i = wrap(static_cast<int>(std::floor(x)), 4);
  const float fx = fraction(x), fy = fraction(y);
  const float rough = fractal(u, v, 32, 32, 3, t.variant + 5);
  const float edge = std::min(std::min(fx, 1.f - fx) * 3.f, std::min(fy, 1.f - fy)) + 0.04f * (rough - 0.5f);
  const float tone = 0.78f + 0.22f * hash_unit(i, j, t.variant) - 0.18f * (1.f - rough);
  return mix((0.9f + 0.1f * rough) * t.colors[1], (tone + 0.1f) * t.colors[0], smooth(0.06f, 0.13f, edge));
}

Rgb marble(const TextureRequest& t, float u, float v) {
  const float warp = fractal(u, v, 3, 3, 5, t.variant), fade = fractal(u, v, 5, 5, 3, t.variant + 2);
  const float vein = std::fabs(std::sin(kTurn * (u + v + 0.9f * warp))),
              fine = std::fabs(std::sin(kTurn * (2.f * u - v + 1.3f * warp)));
  const float ink = 0.6f * (1.f - smooth(0.f, 0.3f * fade, vein)) + 0.35f * (1.f - smooth(0.f, 0.2f * fade, fine));
  const float cloud = fractal(u, v, 4, 4, 5, t.variant + 4);
  return mix((0.92f + 0.1f * cloud) * t.colors[0], t.colors[1], std::min(0.8f, ink * smooth(0.3f, 0.6f, fade) * 1.4f));
}

/// Coloured chips in a pale ground.
Rgb terrazzo(const TextureRequest& t, float u, float v) {
  constexpr int kCells = 28;
  const float x = u * kCells, y = v * kCells;
  for (int j = static_cast<int>(y) - 1; j <= static_cast<int>(y) + 1; ++j) {
    for (int i = static_cast<int>(x) - 1; i <= static_cast<int>(x) + 1; ++i) {
      const int ci = wrap(i, kCells), cj = wrap(j, kCells);
      const float dx = x - static_cast<float>(i) - hash_unit(ci, cj, t.variant),
                  dy = y - static_cast<float>(j) - hash_unit(ci, cj, t.variant + 1);
      const float turn = 3.f * hash_unit(ci, cj, t.variant + 2);
      const float a = std::fabs(dx * std::cos(turn) + dy * std::sin(turn)),
                  b = std::fabs(dy * std::cos(turn) - dx * std::sin(turn));
      const float size = 0.12f + 0.3f * hash_unit(ci, cj, t.variant + 3);
      if (a + 0.7f * b < size) return t.colors[1 + hash(ci, cj, t.variant + 4) % (t.colors.size() - 1)];
    }
  }
  return (0.97f + 0.03f * fractal(u, v, 16, 16, 2, t.variant)) * t.colors[0];
}

/// Vertical boards with grooves, 8 an image.
Rgb boards(const TextureRequest& t, float u, float v) {
  const float x = 8.f * u;
  const float edge = std::min(fraction(x), 1.f - fraction(x));
  const float grain = 0.95f + 0.05f * fractal(v, u, 3, 64, 2, t.variant);
  return mix(0.72f * t.colors[0], grain * t.colors[0], smooth(0.015f, 0.05f, edge));
}

Rgb stripes(const TextureRequest& t, float u, float v) {
  const float x = fraction(4.f * u);
  const float paper = 0.97f + 0.03f * fractal(u, v, 48, 48, 2, t.variant);
  const bool thin = t.variant % 2 == 1;
  const float wide =
      thin ? smooth(0.46f, 0.47f, x) * (1.f - smooth(0.53f, 0.54f, x)) : smooth(0.24f, 0.26f, std::fabs(x - 0.5f));
  return paper * mix(t.colors[0], t.colors[1], wide);
}

/// Ornament on a half-drop raster: a rosette with petals inside a pointed frame.
Rgb damask(const TextureRequest& t, float u, float v) {
  const float x0 = 2.f * u, y0 = 2.f * v + (static_cast<int>(x0) % 2 == 1 ? 0.5f : 0.f);
  const float x = fraction(x0) - 0.5f, y = fraction(y0) - 0.5f;
  const float r = std::hypot(1.25f * x, y), turn = std::atan2(x, y);
  const float petal = 0.2f + 0.09f * std::cos(6.f * turn) + 0.04f * std::cos(12.f * turn);
  const float frame = std::fabs(std::fabs(x) * 1.9f + std::fabs(y) - 0.47f - 0.05f * std::cos(10.f * y));
  const float ink = std::max({1.f - smooth(petal - 0.01f, petal + 0.01f, r), smooth(0.05f, 0.06f, r) * 0.f,
                              (1.f - smooth(0.02f, 0.035f, frame))}) *
                    smooth(0.045f, 0.06f, r);
  return mix(t.colors[0], t.colors[1], ink) * (0.97f + 0.03f * fractal(u, v, 48, 48, 2, t.variant));
}

Rgb trellis(const TextureRequest& t, float u, float v) {
  const float a = fraction(3.f * (u + v)), b = fraction(3.f * (u - v));
  const float line = std::min(std::min(a, 1.f - a), std::min(b, 1.f - b));
  const float knot = std::hypot(std::min(a, 1.f - a), std::min(b, 1.f - b));
  return mix(t.colors[1], t.colors[0], smooth(0.03f, 0.045f, line) * smooth(0.1f, 0.115f, knot));
}

Rgb dots(const TextureRequest& t, float u, float v) {
  const float y0 = 6.f * v, x0 = 6.f * u + (static_cast<int>(y0) % 2 == 1 ? 0.5f : 0.f);
  return mix(t.colors[1], t.colors[0], smooth(0.17f, 0.2f, std::hypot(fraction(x0) - 0.5f, fraction(y0) - 0.5f)));
}

/// Scattered leaves, each with a midrib.
Rgb leaves(const TextureRequest& t, float u, float v) {
  constexpr int kCells = 5;
  const float x = u * kCells, y = v * kCells;
  Rgb color = t.colors[0];
  for (int j = static_cast<int>(y) - 1; j <= static_cast<int>(y) + 1; ++j) {
    for (int i = static_cast<int>(x) - 1; i <= static_cast<int>(x) + 1; ++i) {
      const int ci = wrap(i, kCells), cj = wrap(j, kCells);
      const float dx = x - static_cast<float>(i) - 0.25f - 0.5f * hash_unit(ci, cj, t.variant);
      const float dy = y - static_cast<float>(j) - 0.25f - 0.5f * hash_unit(ci, cj, t.variant + 1);
      const float turn = kTurn * hash_unit(ci, cj, t.variant + 2);
      const float a = dx * std::cos(turn) + dy * std::sin(turn), b = dy * std::cos(turn) - dx * std::sin(turn);
      const float half = 0.2f * (1.f - std::pow(a / 0.55f, 2.f));
      if (std::fabs(a) > 0.55f || std::fabs(b) > half) continue;
      const Rgb& leaf = t.colors[1 + hash(ci, cj, t.variant + 3) % (t.colors.size() - 1)];
      color = mix(mix(leaf, t.colors[0], 0.45f), leaf, smooth(0.012f, 0.03f, std::fabs(b)));
    }
  }
  return color;
}

float weave_tone(const TextureRequest& t, float u, float v) {
  return 0.86f + 0.14f * hash_unit(static_cast<int>(u * 200.f), static_cast<int>(v * 300.f), t.variant + 40);
}

/// Framed field with a medallion in the middle and corner pieces.
Rgb rug_border(const TextureRequest& t, float u, float v) {
  const float edge = std::min(std::min(u, 1.f - u) * 0.75f, std::min(v, 1.f - v));
  const float x = std::fabs(u - 0.5f) * 2.f, y = std::fabs(v - 0.5f) * 2.f;
  Rgb color = t.colors[0];
  const float medallion = std::hypot(x, y) - 0.42f - 0.05f * std::cos(8.f * std::atan2(y, x));
  if (medallion < 0.f) color = t.colors[1];
  if (medallion < -0.12f) color = t.colors[2];
  if (medallion < -0.28f) color = t.colors[0];
  if (x + y > 1.45f) color = t.colors[2];
  if (edge < 0.1f) color = t.colors[1];
  if (edge < 0.1f && edge > 0.03f && fraction(16.f * u) + fraction(16.f * v) > 1.15f) color = t.colors[2];
  if (edge < 0.03f) color = t.colors[0];
  return weave_tone(t, u, v) * color;
}

Rgb rug_stripes(const TextureRequest& t, float u, float v) {
  const int band = static_cast<int>(u * 14.f);
  return weave_tone(t, u, v) * t.colors[hash(band, 0, t.variant) % t.colors.size()];
}

Rgb rug_diamonds(const TextureRequest& t, float u, float v) {
  const float d = std::fabs(fraction(4.f * u) - 0.5f) + std::fabs(fraction(3.f * v) - 0.5f);
  const std::size_t ring = static_cast<std::size_t>(d * 5.99f);
  return weave_tone(t, u, v) * t.colors[ring % t.colors.size()];
}

Rgb rug_shag(const TextureRequest& t, float u, float v) {
  return (0.78f + 0.12f * fractal(u, v, 64, 64, 2, t.variant) + 0.12f * fractal(u, v, 7, 7, 2, t.variant + 1)) *
         t.colors[0];
}

Rgb keyboard(const TextureRequest& t, float u, float v) {
  const float row = 5.f * v;
  const float x = 14.f * u + 0.3f * std::floor(row);
  return border(fraction(x), fraction(row)) > 0.12f ? t.colors[1] : t.colors[0];
}

}  // namespace

TexelFn coloured_pattern(Pattern pattern) {
  switch (pattern) {
    case Pattern::kTiles: return tiles;
    case Pattern::kChecker: return checker;
    case Pattern::kHexagons: return hexagons;
    case Pattern::kBricks: return bricks;
    case Pattern::kMarble: return marble;
    case Pattern::kTerrazzo: return terrazzo;
    case Pattern::kBoards: return boards;
    case Pattern::kStripes: return stripes;
    case Pattern::kDamask: return damask;
    case Pattern::kTrellis: return trellis;
    case Pattern::kDots: return dots;
    case Pattern::kLeaves: return leaves;
    case Pattern::kKeyboard: return keyboard;
    default: return nullptr;
  }
}

TexelFn rug_pattern(Pattern pattern) {
  switch (pattern) {
    case Pattern::kRugBorder: return rug_border;
    case Pattern::kRugStripes: return rug_stripes;
    case Pattern::kRugDiamonds: return rug_diamonds;
    case Pattern::kRugShag: return rug_shag;
    default: return nullptr;
  }
}

}  // namespace wiw::apartment
