// SPDX-License-Identifier: Apache-2.0
// Small things that stand on furniture.
#include "wiw/apartment/furniture/furniture.hpp"

namespace wiw::apartment {

namespace {

Rgb lively(FurnitureBuilder& m) {
  return oklch(range(m.rng, 0.45f, 0.85f), range(m.rng, 0.05f, 0.15f), range(m.rng, 0.f, 360.f));
}

}  // namespace

void make_books(FurnitureBuilder& m) {
  const MaterialId paper = m.plain("paper", Rgb::Ones());
  float y = 0.f;
  const int count = static_cast<int>(2 + m.rng.below(4));
  const Eigen::Affine3f before = m.shape.frame();
  for (int i = 0; i < count; ++i) {
    const Rgb color = lively(m);
    if (i == 0) m.describe(color, "paper");
    const float thick = range(m.rng, 0.018f, 0.04f), hx = range(m.rng, 0.09f, 0.13f), hz = range(m.rng, 0.06f, 0.09f);
    m.shape.set_frame(before * Eigen::AngleAxisf(range(m.rng, -0.25f, 0.25f), Vec3::UnitY()));
    m.shape.set_tint(color);
    m.shape.box(paper, {-hx, y, -hz}, {hx, y + 0.003f, hz});
    m.shape.box(paper, {-hx, y + thick - 0.003f, -hz}, {hx, y + thick, hz});
    m.shape.box(paper, {-hx, y, -hz}, {hx, y + thick, -hz + 0.004f});
    m.shape.set_tint({0.93f, 0.91f, 0.85f});
    m.shape.box(paper, {-hx + 0.004f, y + 0.003f, -hz + 0.004f}, {hx - 0.004f, y + thick - 0.003f, hz - 0.004f});
    y += thick;
  }
  m.shape.set_tint(Rgb::Ones());
  m.shape.set_frame(before);
}

void make_vase(FurnitureBuilder& m) {
  const Rgb color = lively(m);
  m.describe(color, "ceramic");
  const float r = 0.5f * m.w(), h = 0.62f * m.h();
  const float belly = range(m.rng, 0.25f, 0.6f), neck = range(m.rng, 0.3f, 0.6f);
  m.shape.lathe(m.plain("ceramic", color), Vec3::Zero(),
                {{0, 0},
                 {0.5f * r, 0},
                 {0.85f * r, 0.5f * belly * h},
                 {r, belly * h},
                 {0.8f * r, 0.75f * h},
                 {neck * r, 0.9f * h},
                 {(neck + 0.12f) * r, h},
                 {neck * r * 0.8f, 0.98f * h},
                 {0, 0.7f * h}},
                18);
  if (!m.rng.chance(0.65)) return;
  const Rgb bloom = lively(m);
  for (int i = 0; i < 6; ++i) {
    const float turn = 2.4f * static_cast<float>(i), out = range(m.rng, 0.3f, 1.1f) * r;
    const Vec3 tip(out * std::sin(turn), m.h() * range(m.rng, 0.8f, 1.f), out * std::cos(turn));
    m.shape.tube(m.plain("plant", {0.3f, 0.5f, 0.25f}),
                 {{0, 0.8f * h, 0}, {0.4f * tip.x(), 0.75f * tip.y(), 0.4f * tip.z()}, tip}, 0.003f, 4);
    m.shape.ellipsoid(m.plain("plant", bloom), tip, {0.024f, 0.018f, 0.024f}, 8);
  }
}

void make_cup(FurnitureBuilder& m) {
  const Rgb color = lively(m);
  m.describe(color, "ceramic");
  const MaterialId body = m.plain("ceramic", color);
  m.shape.lathe(body, Vec3::Zero(),
                {{0, 0}, {0.032f, 0}, {0.04f, 0.02f}, {0.042f, 0.09f}, {0.039f, 0.09f}, {0.036f, 0.02f}, {0, 0.012f}},
                16);
  m.shape.tube(body, {{0.04f, 0.075f, 0}, {0.068f, 0.07f, 0}, {0.068f, 0.035f, 0}, {0.04f, 0.025f, 0}}, 0.005f, 6);
}

void make_bowl(FurnitureBuilder& m) {
  const Rgb color = lively(m);
  m.describe(color, "ceramic");
  const float r = 0.5f * m.w();
  m.shape.lathe(m.plain("ceramic", color), Vec3::Zero(),
                {{0, 0},
                 {0.4f * r, 0},
                 {0.45f * r, 0.012f},
                 {0.85f * r, 0.05f},
                 {r, 0.09f},
                 {0.96f * r, 0.092f},
                 {0.8f * r, 0.055f},
                 {0.4f * r, 0.02f},
                 {0, 0.018f}},
                22);
  const MaterialId fruit = m.plain("fruit", Rgb::Ones());
  const std::array<Rgb, 4> kFruits{Rgb(0.85f, 0.2f, 0.15f), Rgb(0.95f, 0.6f, 0.15f), Rgb(0.55f, 0.72f, 0.2f),
                                   Rgb(0.95f, 0.85f, 0.3f)};
  for (int i = 0; i < 6; ++i) {
    m.shape.set_tint(pick(m.rng, kFruits));
    const float turn = 1.2566f * static_cast<float>(i), out = i == 5 ? 0.f : 0.5f * r;
    m.shape.ellipsoid(fruit, {out * std::sin(turn), i == 5 ? 0.115f : 0.075f, out * std::cos(turn)},
                      Vec3::Constant(0.036f), 10);
  }
  m.shape.set_tint(Rgb::Ones());
}

void make_bottle(FurnitureBuilder& m) {
  const std::array<Rgb, 4> kGlass{Rgb(0.16f, 0.35f, 0.2f), Rgb(0.35f, 0.2f, 0.1f), Rgb(0.75f, 0.85f, 0.85f),
                                  Rgb(0.2f, 0.3f, 0.55f)};
  const Rgb color = pick(m.rng, kGlass);
  m.describe(color, "glass");
  const float h = m.h();
  m.shape.lathe(m.plain("glass", color), Vec3::Zero(),
                {{0, 0},
                 {0.036f, 0},
                 {0.038f, 0.01f},
                 {0.038f, 0.58f * h},
                 {0.03f, 0.68f * h},
                 {0.014f, 0.78f * h},
                 {0.013f, 0.97f * h},
                 {0.016f, h},
                 {0, h}},
                16);
  m.shape.lathe(m.plain("paper", lively(m)), {0, 0.18f * h, 0}, {{0.0385f, 0}, {0.0385f, 0.3f * h}}, 16);
}

void make_box(FurnitureBuilder& m) {
  const Rgb color = lively(m);
  m.describe(color, "cardboard");
  const float hx = 0.5f * m.w(), hz = 0.5f * m.d(), h = m.h();
  m.shape.soft_box(m.plain("cardboard", color), {-hx + 0.004f, 0, -hz + 0.004f}, {hx - 0.004f, 0.75f * h, hz - 0.004f},
                   0.004f, 0.f, 1);
  m.shape.soft_box(m.plain("cardboard", 0.85f * color), {-hx, 0.72f * h, -hz}, {hx, h, hz}, 0.004f, 0.f, 1);
}

void make_candles(FurnitureBuilder& m) {
  const Rgb color = m.rng.chance(0.5) ? Rgb(0.94f, 0.9f, 0.8f) : lively(m);
  m.describe(color, "wax");
  const MaterialId wax = m.plain("wax", color);
  m.attributes["state"] = m.on ? "on" : "off";
  for (int i = 0; i < 3; ++i) {
    const float x = -0.08f + 0.08f * static_cast<float>(i), z = i == 1 ? 0.03f : -0.02f, h = range(m.rng, 0.06f, 0.16f);
    m.shape.lathe(wax, {x, 0, z}, {{0, 0}, {0.028f, 0}, {0.028f, h - 0.004f}, {0.024f, h}, {0, h - 0.003f}}, 14);
    if (m.on) m.shape.ellipsoid(m.materials.glow({1.f, 0.8f, 0.4f}), {x, h + 0.02f, z}, {0.006f, 0.018f, 0.006f}, 6);
  }
}

void make_photo(FurnitureBuilder& m) {
  const Eigen::Affine3f before = m.shape.frame();
  const float hx = 0.5f * m.w(), h = m.h();
  m.shape.set_frame(before * Eigen::AngleAxisf(-0.18f, Vec3::UnitX()));
  m.describe(m.look.wood, "wood");
  m.shape.soft_box(m.wood(m.look.wood), {-hx, 0, -0.01f}, {hx, h, 0.004f}, 0.004f, 0.f, 1);
  const std::vector<Rgb> colors{lively(m), lively(m), lively(m), lively(m), lively(m)};
  m.shape.image(m.materials.image(Pattern::kPictureHills, colors, m.rng() >> 8, {64, 64}, "paper"),
                {-hx + 0.015f, 0.015f, 0.005f}, {2 * hx - 0.03f, 0, 0}, {0, h - 0.03f, 0});
  m.shape.set_frame(before);
}

void make_small_plant(FurnitureBuilder& m) {
  const Rgb clay = lively(m);
  const float r = 0.055f;
  m.shape.lathe(m.plain("ceramic", clay), Vec3::Zero(),
                {{0, 0}, {0.75f * r, 0}, {r, 0.09f}, {0.9f * r, 0.09f}, {0.85f * r, 0.08f}, {0, 0.08f}}, 14);
  const Rgb leaf = oklch(range(m.rng, 0.5f, 0.68f), 0.12f, range(m.rng, 120.f, 150.f));
  m.describe(leaf, "plant");
  for (int i = 0; i < 12; ++i) {
    const float turn = 2.4f * static_cast<float>(i), out = range(m.rng, 0.02f, 0.08f), y = range(m.rng, 0.1f, 0.19f);
    m.shape.ellipsoid(m.plain("plant", leaf), {out * std::sin(turn), y, out * std::cos(turn)}, {0.028f, 0.016f, 0.028f},
                      6);
  }
}

void make_ball(FurnitureBuilder& m) {
  const Rgb color = lively(m);
  m.describe(color, "rubber");
  const float r = 0.5f * m.w();
  m.shape.ellipsoid(m.plain("rubber", color), {0, r, 0}, Vec3::Constant(r), 18);
  m.shape.lathe(m.plain("rubber", lively(m)), {0, r, 0},
                {{0.985f * r, -0.2f * r}, {1.008f * r, 0}, {0.985f * r, 0.2f * r}}, 22);
}

}  // namespace wiw::apartment
