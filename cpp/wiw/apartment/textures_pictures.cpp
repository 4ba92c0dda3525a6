// SPDX-License-Identifier: Apache-2.0
// Small paintings for walls and screens. colors[0] is the ground, the rest is the painter's palette.
#include "wiw/apartment/noise.hpp"
#include "wiw/apartment/textures.hpp"

namespace wiw::apartment {

namespace {

constexpr float kTurn = 6.2831853f;

Rgb mix(const Rgb& a, const Rgb& b, float t) { return a + t * (b - a); }
const Rgb& paint(const TextureRequest& t, std::uint32_t i) { return t.colors[1 + i % (t.colors.size() - 1)]; }

/// Sky with a sun over ranges of hills, nearer ones darker.
Rgb hills(const TextureRequest& t, float u, float v) {
  Rgb color = mix(paint(t, 0), t.colors[0], smooth(0.f, 0.6f, v));
  const float sun_x = 0.2f + 0.6f * hash_unit(0, 0, t.variant), sun_y = 0.18f + 0.2f * hash_unit(1, 0, t.variant);
  color = mix(Rgb(1.f, 0.95f, 0.75f), color, smooth(0.07f, 0.09f, std::hypot(u - sun_x, v - sun_y)));
  for (int i = 0; i < 4; ++i) {
    const float level = 0.42f + 0.14f * static_cast<float>(i);
    const float ridge = level + 0.12f *
                                    (fractal(0.999f * u, 0.1f * static_cast<float>(i), 3 + i, 3, 4,
                                             t.variant + static_cast<std::uint32_t>(i)) -
                                     0.5f) *
                                    2.f;
    if (v > ridge) color = (0.95f - 0.15f * static_cast<float>(i)) * paint(t, static_cast<std::uint32_t>(i) + 1);
  }
  return color * (0.93f + 0.07f * noise(u * 80.f, v * 80.f, 80, 80, t.variant + 20));
}

/// Rectangles between black bars.
Rgb blocks(const TextureRequest& t, float u, float v) {
  float x0 = 0.f, x1 = 1.f, y0 = 0.f, y1 = 1.f;
  std::uint32_t id = t.variant;
  for (int depth = 0; depth < 4; ++depth) {
    id = hash(id * 2u + 1u);
    const float cut = 0.3f + 0.4f * static_cast<float>(hash(id) >> 8) * 0x1p-24f;
    if ((depth + static_cast<int>(t.variant)) % 2 == 0) {
      const float at = x0 + cut * (x1 - x0);
      if (std::fabs(u - at) < 0.012f) return Rgb::Constant(0.08f);
      if (u < at)
        x1 = at;
      else
        x0 = at, id ^= 0x55u;
    } else {
      const float at = y0 + cut * (y1 - y0);
      if (std::fabs(v - at) < 0.012f) return Rgb::Constant(0.08f);
      if (v < at)
        y1 = at;
      else
        y0 = at, id ^= 0xAAu;
    }
  }
  return hash(id) % 5u < 2u ? t.colors[0] : paint(t, hash(id + 7u));
}

Rgb circles(const TextureRequest& t, float u, float v) {
  Rgb color = t.colors[0];
  for (int i = 0; i < 7; ++i) {
    const float r = 0.08f + 0.22f * hash_unit(i, 2, t.variant);
    const float d = std::hypot(u - hash_unit(i, 0, t.variant), v - hash_unit(i, 1, t.variant));
    if (d < r) color = mix(color, paint(t, static_cast<std::uint32_t>(i)), (i % 3 == 2 && d < 0.7f * r) ? 0.1f : 0.85f);
  }
  return color;
}

Rgb flower(const TextureRequest& t, float u, float v) {
  const float x = u - 0.5f, y = v - 0.4f;
  const float r = std::hypot(x, y), turn = std::atan2(y, x);
  const int petals = 5 + static_cast<int>(t.variant % 4u);
  const float edge = 0.24f * (0.65f + 0.35f * std::fabs(std::cos(0.5f * static_cast<float>(petals) * turn)));
  if (r < 0.06f) return paint(t, 2);
  if (r < edge) return mix(paint(t, 0), t.colors[0], 0.5f * r / edge);
  const bool stem = v > 0.5f && std::fabs(x - 0.03f * std::sin(8.f * v)) < 0.012f;
  const bool leaf = std::hypot((std::fabs(x) - 0.12f) * 1.f, (v - 0.78f + 0.6f * std::fabs(x)) * 3.2f) < 0.11f;
  return stem || leaf ? paint(t, 1) : t.colors[0];
}

/// Towers with lit windows before a glowing sky.
Rgb skyline(const TextureRequest& t, float u, float v) {
  Rgb color = mix(paint(t, 0), t.colors[0], v);
  for (int layer = 0; layer < 2; ++layer) {
    const float x = u * (9.f - 2.f * static_cast<float>(layer));
    const int tower = static_cast<int>(x);
    const float roof = 0.75f - (0.45f - 0.12f * static_cast<float>(layer)) * hash_unit(tower, layer, t.variant) +
                       0.1f * static_cast<float>(layer);
    if (v < roof) continue;
    color = (0.55f - 0.25f * static_cast<float>(layer)) * paint(t, 1);
    const int wx = static_cast<int>(x * 4.f), wy = static_cast<int>(v * 26.f);
    const bool lit = hash_unit(wx, wy, t.variant + 3) < 0.3f && wx % 4 != 0 && wy % 2 == 0;
    if (lit && layer == 1) color = paint(t, 2);
  }
  return color;
}

Rgb waves(const TextureRequest& t, float u, float v) {
  const float bend = v * 9.f + 1.1f * std::sin(kTurn * u * (1.f + static_cast<float>(t.variant % 3u))) +
                     2.f * fractal(0.99f * u, 0.99f * v, 2, 2, 2, t.variant);
  const int band = static_cast<int>(std::floor(bend));
  return (0.88f + 0.12f * (bend - static_cast<float>(band))) * t.colors[hash(band, 0, t.variant) % t.colors.size()];
}

/// Still life: a table, a bowl and three fruits.
Rgb fruit(const TextureRequest& t, float u, float v) {
  Rgb color = v < 0.66f ? mix(t.colors[0], 0.8f * t.colors[0], u) : 0.7f * paint(t, 2);
  for (int i = 0; i < 3; ++i) {
    const float x = (u - 0.32f - 0.18f * static_cast<float>(i)) / 0.12f,
                y = (v - 0.47f + 0.03f * static_cast<float>(i % 2)) / 0.12f;
    const float d = x * x + y * y;
    if (d < 1.f) color = paint(t, static_cast<std::uint32_t>(i)) * (1.f - 0.35f * smooth(0.f, 1.2f, x + y));
  }
  const float bowl = std::hypot((u - 0.5f) / 0.32f, (v - 0.52f) / 0.24f);
  if (v > 0.52f && bowl < 1.f) color = paint(t, 3) * (0.95f - 0.4f * smooth(0.3f, 0.85f, u));
  return color * (0.95f + 0.05f * fractal(0.99f * u, 0.99f * v, 30, 30, 2, t.variant));
}

}  // namespace

TexelFn picture_pattern(Pattern pattern) {
  switch (pattern) {
    case Pattern::kPictureHills: return hills;
    case Pattern::kPictureBlocks: return blocks;
    case Pattern::kPictureCircles: return circles;
    case Pattern::kPictureFlower: return flower;
    case Pattern::kPictureSkyline: return skyline;
    case Pattern::kPictureWaves: return waves;
    case Pattern::kPictureFruit: return fruit;
    default: return nullptr;
  }
}

}  // namespace wiw::apartment
