// SPDX-License-Identifier: Apache-2.0
#include "wiw/apartment/furniture/furniture.hpp"

namespace wiw::apartment {

namespace {

MaterialId screen(FurnitureBuilder& m) {
  m.attributes["state"] = m.on ? "on" : "off";
  if (!m.on) return m.plain("glass", {0.05f, 0.05f, 0.06f});
  constexpr std::array<Pattern, 4> kShows{Pattern::kPictureHills, Pattern::kPictureSkyline, Pattern::kPictureCircles,
                                          Pattern::kPictureWaves};
  const Pattern show = pick(m.rng, kShows);
  const std::vector<Rgb> colors{
      {0.55f, 0.75f, 0.95f}, m.look.fabrics[0], m.look.fabrics[1], m.look.accent, {0.25f, 0.5f, 0.3f}};
  return m.materials.image(show, colors, m.rng() >> 8, {108, 192}, "glass", true);
}

}  // namespace

void make_television(FurnitureBuilder& m) {
  const float hx = 0.5f * m.w(), h = m.h(), z = -0.03f;
  m.describe({0.1f, 0.1f, 0.11f}, "plastic");
  m.shape.soft_box(m.black(), {-hx, 0.06f, z - 0.03f}, {hx, h, z}, 0.008f, 0.f, 1);
  m.shape.image(screen(m), {-hx + 0.015f, 0.085f, z + 0.001f}, {2 * hx - 0.03f, 0, 0}, {0, h - 0.1f, 0});
  for (const float x : {-0.55f * hx, 0.55f * hx})
    m.shape.tube(m.black(),
                 {{x, 0.07f, z - 0.015f}, {x, 0.012f, z + 0.1f}, {x, 0.07f, z - 0.015f}, {x, 0.012f, z - 0.1f}}, 0.009f,
                 6);
}

void make_laptop(FurnitureBuilder& m) {
  const Rgb color(0.66f, 0.67f, 0.69f);
  m.describe(color, "metal");
  const MaterialId body = m.plain("metal", color);
  m.shape.soft_box(body, {-0.17f, 0, -0.11f}, {0.17f, 0.016f, 0.12f}, 0.006f, 0.f, 1);
  m.shape.image(m.materials.image(Pattern::kKeyboard, {color, {0.15f, 0.15f, 0.16f}}, 1, {64, 128}, "plastic"),
                {-0.145f, 0.0165f, 0.03f}, {0.29f, 0, 0}, {0, 0, -0.11f});
  const Eigen::Affine3f before = m.shape.frame();
  m.shape.set_frame(before * Eigen::Translation3f(0, 0.014f, -0.11f) * Eigen::AngleAxisf(-0.3f, Vec3::UnitX()));
  m.shape.soft_box(body, {-0.17f, 0, -0.008f}, {0.17f, 0.22f, 0.f}, 0.003f, 0.f, 1);
  m.shape.image(screen(m), {-0.16f, 0.012f, 0.001f}, {0.32f, 0, 0}, {0, 0.2f, 0});
  m.shape.set_frame(before);
}

void make_microwave(FurnitureBuilder& m) {
  const Rgb color = m.rng.chance(0.5) ? Rgb(0.9f, 0.9f, 0.9f) : Rgb(0.25f, 0.25f, 0.27f);
  m.describe(color, "metal");
  const float hx = 0.5f * m.w(), hz = 0.5f * m.d(), h = m.h();
  m.shape.soft_box(m.plain("metal", color), {-hx, 0.01f, -hz}, {hx, h, hz - 0.012f}, 0.012f);
  m.shape.box(m.plain("glass", {0.08f, 0.08f, 0.09f}), {-hx + 0.02f, 0.04f, hz - 0.013f},
              {hx - 0.12f, h - 0.03f, hz - 0.005f});
  m.shape.tube(m.chrome(),
               {{hx - 0.1f, 0.05f, hz - 0.012f},
                {hx - 0.1f, 0.05f, hz + 0.012f},
                {hx - 0.1f, h - 0.05f, hz + 0.012f},
                {hx - 0.1f, h - 0.05f, hz - 0.012f}},
               0.007f, 6);
  m.shape.cylinder(m.chrome(), {hx - 0.045f, 0.35f * h, hz - 0.012f}, {hx - 0.045f, 0.35f * h, hz + 0.004f}, 0.024f,
                   0.02f, 12);
}

void make_kettle(FurnitureBuilder& m) {
  const Rgb color = m.rng.chance(0.5) ? Rgb(0.74f, 0.75f, 0.76f) : m.look.fabrics[m.rng.below(2)];
  m.describe(color, "metal");
  const MaterialId body = m.plain("metal", color);
  m.shape.lathe(body, Vec3::Zero(),
                {{0, 0}, {0.08f, 0}, {0.082f, 0.02f}, {0.078f, 0.06f}, {0.06f, 0.19f}, {0.045f, 0.21f}, {0, 0.215f}},
                18);
  m.shape.tube(m.black(), {{-0.06f, 0.19f, 0}, {-0.12f, 0.19f, 0}, {-0.125f, 0.1f, 0}, {-0.085f, 0.05f, 0}}, 0.01f, 6);
  m.shape.tube(body, {{0.055f, 0.14f, 0}, {0.09f, 0.185f, 0}}, 0.014f, 8);
  m.shape.ellipsoid(m.black(), {0, 0.22f, 0}, {0.014f, 0.012f, 0.014f}, 8);
}

void make_speaker(FurnitureBuilder& m) {
  const MaterialId wood = m.case_material(m.case_color());
  const float hx = 0.5f * m.w(), hz = 0.5f * m.d(), h = m.h();
  m.shape.soft_box(wood, {-hx, 0, -hz}, {hx, h, hz - 0.01f}, 0.01f, 0.f, 1);
  const Eigen::Affine3f before = m.shape.frame();
  for (const auto& [y, r] :
       {std::pair{0.3f * h, 0.36f * m.w()}, std::pair{0.62f * h, 0.3f * m.w()}, std::pair{0.85f * h, 0.14f * m.w()}}) {
    m.shape.set_frame(before * Eigen::Translation3f(0, y, hz - 0.011f) * Eigen::AngleAxisf(1.5708f, Vec3::UnitX()));
    m.shape.lathe(m.black(), Vec3::Zero(),
                  {{r, 0},
                   {r, 0.012f},
                   {0.88f * r, 0.016f},
                   {0.8f * r, 0.006f},
                   {0.3f * r, 0.f},
                   {0.2f * r, 0.008f},
                   {0, 0.012f}},
                  18);
  }
  m.shape.set_frame(before);
}

void make_piano(FurnitureBuilder& m) {
  const double kind = m.rng.uniform();
  const Rgb color = kind < 0.5 ? Rgb(0.07f, 0.07f, 0.08f) : m.look.wood;
  m.describe(color, "wood");
  const MaterialId body = kind < 0.5 ? m.plain("lacquer", color) : m.wood(color);
  const float hx = 0.5f * m.w(), hz = 0.5f * m.d(), h = m.h(), key = 0.7f;
  m.shape.soft_box(body, {-hx, 0.04f, -hz}, {hx, h, -hz + 0.32f}, 0.012f, 0.f, 1);
  m.shape.soft_box(body, {-hx - 0.01f, h - 0.02f, -hz}, {hx + 0.01f, h + 0.015f, -hz + 0.35f}, 0.008f, 0.f, 1);
  m.shape.soft_box(body, {-hx, key - 0.09f, -hz + 0.3f}, {hx, key - 0.02f, hz}, 0.01f, 0.f, 1);
  for (const float x : {-hx, hx - 0.06f}) {
    m.shape.soft_box(body, {x, key - 0.09f, -hz + 0.3f}, {x + 0.06f, key + 0.06f, hz}, 0.015f, 0.f, 1);
    m.shape.lathe(body, {x + 0.03f, 0, hz - 0.06f},
                  {{0.03f, 0}, {0.035f, 0.05f}, {0.02f, 0.1f}, {0.035f, 0.4f}, {0.02f, 0.5f}, {0.03f, key - 0.09f}},
                  10);
  }
  m.shape.box(m.plain("plastic", {0.93f, 0.92f, 0.88f}), {-hx + 0.07f, key - 0.02f, hz - 0.17f},
              {hx - 0.07f, key, hz - 0.02f});
  const int keys = 35;
  for (int i = 0; i < keys; ++i) {
    if (i % 7 == 2 || i % 7 == 6) continue;
    const float x = -hx + 0.07f + (2 * hx - 0.14f) * (static_cast<float>(i) + 1.f) / static_cast<float>(keys + 1);
    m.shape.box(m.black(), {x - 0.006f, key, hz - 0.17f}, {x + 0.006f, key + 0.01f, hz - 0.075f});
  }
  m.shape.box(m.plain("paper", {0.95f, 0.94f, 0.9f}), {-0.16f, key + 0.14f, -hz + 0.325f},
              {0.16f, key + 0.38f, -hz + 0.332f});
  m.supports.push_back({{0, h + 0.015f, -hz + 0.16f}, {hx - 0.1f, 0.08f}, 0.6f});
}

}  // namespace wiw::apartment
