// SPDX-License-Identifier: Apache-2.0
#include "wiw/apartment/furniture/furniture.hpp"

namespace wiw::apartment {

Rgb lit_shade(const Rgb& color) {
  return to_encoded((to_linear(color) * 1.1f + Rgb(0.35f, 0.28f, 0.18f)).cwiseMin(1.f));
}

namespace {

MaterialId shade(FurnitureBuilder& m, const Rgb& color) {
  m.attributes["state"] = m.on ? "on" : "off";
  m.describe(color, "fabric");
  if (!m.on) return m.fabric(color);
  return m.materials.glow(lit_shade(color));
}

Rgb shade_color(FurnitureBuilder& m) {
  constexpr std::array<float, 3> kPlain{0.95f, 0.92f, 0.86f};
  return m.rng.chance(0.55) ? Rgb(kPlain[0], kPlain[1], kPlain[2]) : m.look.fabrics[m.rng.below(2)];
}

void add_open_shade(FurnitureBuilder& m, MaterialId cloth, const Vec3& base, float low, float high, float height) {
  m.shape.lathe(cloth, base, {{low, 0}, {high, height}}, 22);
  m.shape.lathe(cloth, base, {{high - 0.003f, height}, {low - 0.003f, 0}}, 22);
}

}  // namespace

void make_ceiling_lamp(FurnitureBuilder& m) {
  m.casts_shadow = false;
  const float r = 0.5f * m.w(), h = m.h();
  const Rgb color(0.97f, 0.95f, 0.9f);
  const MaterialId glass = m.on ? m.materials.glow({1.f, 0.98f, 0.92f}) : m.plain("glass", color);
  m.describe(color, "glass");
  m.attributes["state"] = m.on ? "on" : "off";
  const int style = static_cast<int>(m.rng.below(3));
  if (style == 0) {
    m.shape.lathe(glass, {0, 0, 0}, {{0, 0}, {0.5f * r, 0.02f * r}, {0.85f * r, 0.2f * h}, {r, 0.6f * h}, {r, h}}, 28);
  } else if (style == 1) {
    m.shape.lathe(glass, {0, 0, 0}, {{0, 0}, {r, 0}, {r, 0}, {r, 0.7f * h}}, 28);
    m.shape.lathe(m.chrome(), {0, 0.7f * h, 0}, {{0, 0}, {1.03f * r, 0}, {1.03f * r, 0.3f * h}}, 28);
  } else {
    m.shape.cylinder(m.chrome(), {0, h - 0.03f, 0}, {0, h, 0}, 0.4f * r, 0.4f * r, 18);
    for (int i = 0; i < 3; ++i) {
      const float turn = 2.0944f * static_cast<float>(i);
      const Vec3 at(0.65f * r * std::sin(turn), 0.35f * h, 0.65f * r * std::cos(turn));
      m.shape.tube(m.chrome(), {{0, h - 0.02f, 0}, {at.x(), h - 0.025f, at.z()}, {at.x(), at.y() + 0.04f, at.z()}},
                   0.008f, 6);
      m.shape.ellipsoid(glass, at, Vec3::Constant(0.06f), 16);
    }
  }
  if (m.on) m.bulbs.push_back({{0, -0.3f, 0}, 1.f});
}

void make_pendant(FurnitureBuilder& m) {
  m.casts_shadow = false;
  const float r = 0.5f * m.w(), h = m.h(), tall = range(m.rng, 0.2f, 0.3f);
  m.shape.tube(m.black(), {{0, tall, 0}, {0, h, 0}}, 0.004f, 6);
  m.shape.cylinder(m.black(), {0, h - 0.02f, 0}, {0, h, 0}, 0.05f, 0.05f, 14);
  const MaterialId cloth = shade(m, shade_color(m));
  if (m.rng.chance(0.4))
    m.shape.ellipsoid(cloth, {0, 0.5f * tall, 0}, {r, 0.5f * tall, r}, 22);
  else
    add_open_shade(m, cloth, {0, 0, 0}, r, m.rng.chance(0.5) ? 0.35f * r : 0.9f * r, tall);
  m.shape.ellipsoid(m.on ? m.materials.glow({1.f, 0.97f, 0.88f}) : m.white(), {0, 0.4f * tall, 0},
                    Vec3::Constant(0.04f), 10);
  if (m.on) m.bulbs.push_back({{0, -0.1f, 0}, 1.f});
}

void make_floor_lamp(FurnitureBuilder& m) {
  m.casts_shadow = false;
  const MaterialId metal = m.rng.chance(0.5) ? m.black() : m.chrome();
  const float h = m.h(), r = 0.5f * m.w();
  m.shape.lathe(metal, Vec3::Zero(), {{0, 0}, {0.14f, 0}, {0.14f, 0.012f}, {0.03f, 0.025f}, {0.012f, 0.05f}}, 20);
  m.shape.cylinder(metal, {0, 0.02f, 0}, {0, h - 0.16f, 0}, 0.011f, 0.011f, 8);
  add_open_shade(m, shade(m, shade_color(m)), {0, h - 0.3f, 0}, r, 0.7f * r, 0.3f);
  if (m.on) m.bulbs.push_back({{0, h - 0.12f, 0}, 0.3f});
}

void make_table_lamp(FurnitureBuilder& m) {
  m.casts_shadow = false;
  const Rgb color = oklch(range(m.rng, 0.4f, 0.85f), range(m.rng, 0.03f, 0.12f), range(m.rng, 0.f, 360.f));
  const float h = m.h(), r = 0.5f * m.w();
  m.shape.lathe(
      m.plain("ceramic", color), Vec3::Zero(),
      {{0, 0}, {0.06f, 0}, {0.065f, 0.01f}, {0.05f, 0.03f}, {0.07f, 0.3f * h}, {0.03f, 0.5f * h}, {0.012f, 0.6f * h}},
      16);
  add_open_shade(m, shade(m, shade_color(m)), {0, 0.55f * h, 0}, r, 0.65f * r, 0.45f * h);
  if (m.on) m.bulbs.push_back({{0, h + 0.02f, 0}, 0.16f});
}

}  // namespace wiw::apartment
