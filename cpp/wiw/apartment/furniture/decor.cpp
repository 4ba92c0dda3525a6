// SPDX-License-Identifier: Apache-2.0
#include "wiw/apartment/furniture/furniture.hpp"

namespace wiw::apartment {

namespace {

constexpr float kTurn = 6.2831853f;

constexpr std::array<Pattern, 7> kPaintings{Pattern::kPictureHills,  Pattern::kPictureBlocks,  Pattern::kPictureCircles,
                                            Pattern::kPictureFlower, Pattern::kPictureSkyline, Pattern::kPictureWaves,
                                            Pattern::kPictureFruit};

/// Bent leaf from `base` outwards; two crossing strips would look flat from above, so the blade is folded along its
/// rib.
void add_leaf(FurnitureBuilder& m, MaterialId green, const Vec3& base, float turn, float length, float width,
              float rise, float droop) {
  const Vec3 out(std::sin(turn), 0, std::cos(turn)), side(std::cos(turn), 0, -std::sin(turn));
  constexpr int kSteps = 5;
  const auto rib = [&](int i) {
    const float t = static_cast<float>(i) / kSteps;
    return Vec3(base + out * (length * t) + Vec3(0, rise * t - droop * t * t, 0));
  };
  const auto half = [&](int i) {
    const float t = static_cast<float>(i) / kSteps;
    return width * std::sqrt(std::max(0.f, std::sin(0.5f * kTurn * (0.06f + 0.94f * t))));
  };
  for (int i = 0; i < kSteps; ++i) {
    for (const float s : {-1.f, 1.f}) {
      const Vec3 a = rib(i), b = rib(i + 1);
      const Vec3 c = b + s * half(i + 1) * side + Vec3(0, 0.3f * half(i + 1), 0),
                 d = a + s * half(i) * side + Vec3(0, 0.3f * half(i), 0);
      s > 0 ? m.shape.patch(green, a, d, c, b) : m.shape.patch(green, a, b, c, d);
    }
  }
}

}  // namespace

void make_rug(FurnitureBuilder& m) {
  constexpr std::array<Pattern, 4> kStyles{Pattern::kRugBorder, Pattern::kRugStripes, Pattern::kRugDiamonds,
                                           Pattern::kRugShag};
  const Pattern style = pick(m.rng, kStyles);
  const Rgb color = m.look.fabrics[m.rng.below(2)];
  const Rgb other = color == m.look.fabrics[0] ? m.look.fabrics[1] : m.look.fabrics[0];
  m.describe(color, "textile");
  const MaterialId face =
      m.materials.image(style, {color, other, m.look.fabrics[2], m.look.accent}, m.rng() >> 8, {256, 256}, "textile");
  const float hx = 0.5f * m.w(), hz = 0.5f * m.d(), h = m.h();
  m.shape.set_edge(0.09f);
  m.shape.image(face, {-hx, h, hz}, {2 * hx, 0, 0}, {0, 0, -2 * hz});
  const MaterialId edge = m.fabric(color);
  m.shape.quad(edge, {-hx, 0, hz}, {2 * hx, 0, 0}, {0, h, 0});
  m.shape.quad(edge, {hx, 0, -hz}, {-2 * hx, 0, 0}, {0, h, 0});
  m.shape.quad(edge, {hx, 0, hz}, {0, 0, -2 * hz}, {0, h, 0});
  m.shape.quad(edge, {-hx, 0, -hz}, {0, 0, 2 * hz}, {0, h, 0});
}

void make_plant(FurnitureBuilder& m) {
  const float r = 0.5f * m.w(), h = m.h(), pot = range(m.rng, 0.2f, 0.3f);
  const Rgb clay = m.rng.chance(0.5) ? m.look.fabrics[m.rng.below(3)] : Rgb(0.72f, 0.45f, 0.33f);
  const float pr = std::min(0.17f, 0.6f * r);
  m.shape.lathe(m.plain("ceramic", clay), Vec3::Zero(),
                {{0, 0},
                 {0.75f * pr, 0},
                 {0.75f * pr, 0},
                 {pr, 0.95f * pot},
                 {1.06f * pr, pot},
                 {0.95f * pr, pot},
                 {0.9f * pr, 0.92f * pot},
                 {0, 0.9f * pot}},
                18);
  const Rgb leaf = oklch(range(m.rng, 0.45f, 0.62f), range(m.rng, 0.08f, 0.13f), range(m.rng, 125.f, 150.f));
  m.describe(leaf, "plant");
  const MaterialId green = m.plain("plant", leaf);
  const int style = static_cast<int>(m.rng.below(3));
  if (style == 0) {  // upright blades
    for (int i = 0; i < 16; ++i)
      add_leaf(m, green, {0, 0.9f * pot, 0}, 2.4f * static_cast<float>(i), range(m.rng, 0.25f, 0.6f) * r, 0.03f,
               (h - pot) * range(m.rng, 0.7f, 1.05f), 0.05f);
  } else if (style == 1) {  // fountain of arching leaves
    for (int i = 0; i < 22; ++i)
      add_leaf(m, green, {0, 0.9f * pot, 0}, 2.4f * static_cast<float>(i), r * range(m.rng, 0.8f, 1.1f), 0.035f,
               (h - pot) * range(m.rng, 1.f, 2.f), (h - pot) * range(m.rng, 0.7f, 1.2f));
  } else {  // a small tree
    m.shape.tube(m.wood({0.45f, 0.33f, 0.24f}), {{0, 0.8f * pot, 0}, {0.02f, 0.5f * h, 0.01f}, {0, 0.85f * h, 0}},
                 0.016f, 8);
    for (int i = 0; i < 30; ++i) {
      const float y = h * range(m.rng, 0.5f, 0.92f);
      add_leaf(m, green, {0, y, 0}, 2.4f * static_cast<float>(i), r * range(m.rng, 0.6f, 1.f), 0.05f, 0.12f, 0.16f);
    }
  }
}

void make_picture(FurnitureBuilder& m) {
  const float hx = 0.5f * m.w(), h = m.h(), z = -0.5f * m.d();
  const Rgb frame_color = m.rng.chance(0.4)   ? m.look.wood
                          : m.rng.chance(0.5) ? Rgb(0.1f, 0.1f, 0.1f)
                                              : Rgb(0.93f, 0.92f, 0.9f);
  const MaterialId frame = m.plain("wood", frame_color);
  const float bar = range(m.rng, 0.018f, 0.05f), deep = 0.025f;
  m.shape.soft_box(frame, {-hx, 0, z}, {hx, bar, z + deep}, 0.005f, 0.f, 1);
  m.shape.soft_box(frame, {-hx, h - bar, z}, {hx, h, z + deep}, 0.005f, 0.f, 1);
  m.shape.soft_box(frame, {-hx, bar, z}, {-hx + bar, h - bar, z + deep}, 0.005f, 0.f, 1);
  m.shape.soft_box(frame, {hx - bar, bar, z}, {hx, h - bar, z + deep}, 0.005f, 0.f, 1);
  const float mat = m.rng.chance(0.5) ? range(m.rng, 0.03f, 0.07f) : 0.f;
  const float x = hx - bar, y0 = bar, y1 = h - bar;
  if (mat > 0.f)
    m.shape.quad(m.plain("paper", {0.95f, 0.94f, 0.92f}), {-x, y0, z + 0.008f}, {2 * x, 0, 0}, {0, y1 - y0, 0});
  const float hue = range(m.rng, 0.f, 360.f);
  std::vector<Rgb> colors{oklch(range(m.rng, 0.85f, 0.95f), 0.04f, hue)};
  for (int i = 0; i < 4; ++i)
    colors.push_back(oklch(range(m.rng, 0.35f, 0.85f), range(m.rng, 0.06f, 0.16f), hue + range(m.rng, 40.f, 320.f)));
  m.describe(colors[1], "canvas");
  const int tall = h > m.w() ? 160 : 112;
  const MaterialId art = m.materials.image(pick(m.rng, kPaintings), colors, m.rng() >> 8, {tall, 272 - tall}, "canvas");
  m.shape.image(art, {-x + mat, y0 + mat, z + 0.01f}, {2 * (x - mat), 0, 0}, {0, y1 - y0 - 2 * mat, 0});
}

void make_mirror(FurnitureBuilder& m) {
  const float hx = 0.5f * m.w(), h = m.h(), z = -0.5f * m.d();
  m.describe(m.look.wood, "glass");
  // Renderers here do not trace reflections: pale glass stands for the reflected room.
  const MaterialId glass = m.plain("mirror", {0.77f, 0.82f, 0.85f});
  if (m.rng.chance(0.3)) {
    const Eigen::Affine3f before = m.shape.frame();
    const float r = std::min(hx, 0.5f * h);
    m.shape.set_frame(before * Eigen::Translation3f(0, 0.5f * h, z) * Eigen::AngleAxisf(kTurn / 4, Vec3::UnitX()));
    m.shape.lathe(m.wood(m.look.wood), Vec3::Zero(), {{r, 0}, {r, 0.02f}, {r - 0.02f, 0.025f}, {r - 0.03f, 0.008f}},
                  32);
    m.shape.lathe(m.plain("mirror", {0.77f, 0.82f, 0.85f}), Vec3::Zero(), {{r - 0.028f, 0.009f}, {0, 0.009f}}, 32);
    m.shape.set_frame(before);
    return;
  }
  m.shape.soft_box(m.wood(m.look.wood), {-hx, 0, z}, {hx, h, z + 0.02f}, 0.006f, 0.f, 1);
  m.shape.quad(glass, {-hx + 0.025f, 0.025f, z + 0.0215f}, {2 * hx - 0.05f, 0, 0}, {0, h - 0.05f, 0});
}

void make_clock(FurnitureBuilder& m) {
  const float r = 0.5f * m.w();
  const Rgb color = m.look.fabrics[m.rng.below(2)];
  m.describe(color, "plastic");
  const Eigen::Affine3f before = m.shape.frame();
  m.shape.set_frame(before * Eigen::Translation3f(0, r, -0.5f * m.d()) * Eigen::AngleAxisf(kTurn / 4, Vec3::UnitX()));
  m.shape.lathe(m.plain("plastic", color), Vec3::Zero(),
                {{r, 0}, {r, 0.025f}, {r - 0.01f, 0.032f}, {r - 0.022f, 0.02f}}, 28);
  m.shape.lathe(m.plain("paper", {0.95f, 0.95f, 0.93f}), Vec3::Zero(), {{r - 0.02f, 0.02f}, {0, 0.02f}}, 28);
  m.shape.set_frame(before * Eigen::Translation3f(0, r, -0.5f * m.d() + 0.021f));
  for (int i = 0; i < 12; ++i) {
    const float turn = kTurn * static_cast<float>(i) / 12.f;
    const Vec3 at(0.8f * r * std::sin(turn), 0.8f * r * std::cos(turn), 0);
    m.shape.box(m.black(), at - Vec3(0.005f, 0.005f, 0), at + Vec3(0.005f, 0.005f, 0.002f));
  }
  for (const auto& [turn, length] :
       {std::pair{range(m.rng, 0.f, kTurn), 0.65f}, std::pair{range(m.rng, 0.f, kTurn), 0.45f}}) {
    m.shape.tube(m.black(), {{0, 0, 0.002f}, {length * r * std::sin(turn), length * r * std::cos(turn), 0.002f}},
                 0.004f, 4);
  }
  m.shape.set_frame(before);
}

void make_curtain(FurnitureBuilder& m) {
  const Rgb color = m.fabric_color();
  const MaterialId cloth = m.fabric(color);
  const float hx = 0.5f * m.w(), h = m.h();
  m.shape.tube(m.chrome(), {{-hx, h, 0}, {hx, h, 0}}, 0.012f, 8);
  for (const float x : {-hx, hx}) m.shape.ellipsoid(m.chrome(), {x, h, 0}, {0.022f, 0.022f, 0.022f}, 8);
  const double draw = m.rng.uniform();
  const std::string state = !m.state.empty() ? m.state : draw < 0.75 ? "open" : "half drawn";
  const float share = state == "closed" ? 0.485f
                      : state == "open" ? range(m.rng, 0.12f, 0.18f)
                                        : range(m.rng, 0.24f, 0.34f);
  m.attributes["state"] = state;
  const int folds = std::max(3, static_cast<int>(share * m.w() / 0.07f));
  for (const float side : {-1.f, 1.f}) {
    const float a = side * (hx - 0.04f), b = side * (hx - 0.04f - share * m.w());
    m.shape.drape(cloth, {std::min(a, b), 0.02f, -0.05f}, {std::max(a, b), h - 0.015f, 0.05f}, folds);
  }
}

void make_radiator(FurnitureBuilder& m) {
  const Rgb color = m.look.trim;
  m.describe(color, "metal");
  const MaterialId body = m.plain("metal", color);
  const float hx = 0.5f * m.w(), h = m.h(), hz = 0.5f * m.d();
  const int fins = std::max(4, static_cast<int>(m.w() / 0.07f));
  for (int i = 0; i < fins; ++i) {
    const float x = -hx + m.w() * (static_cast<float>(i) + 0.5f) / static_cast<float>(fins);
    m.shape.soft_box(body, {x - 0.026f, 0.12f, -hz + 0.02f}, {x + 0.026f, h, hz}, 0.018f, 0.f, 2);
  }
  for (const float y : {0.16f, h - 0.06f}) m.shape.tube(body, {{-hx, y, 0.01f}, {hx, y, 0.01f}}, 0.018f, 8);
  m.shape.tube(body, {{hx - 0.01f, 0.16f, 0.01f}, {hx + 0.04f, 0.16f, 0.01f}, {hx + 0.04f, 0.f, 0.01f}}, 0.009f, 6);
}

void make_bin(FurnitureBuilder& m) {
  const Rgb color = m.rng.chance(0.5) ? m.look.fabrics[m.rng.below(2)] : Rgb(0.7f, 0.71f, 0.72f);
  m.describe(color, "plastic");
  const float r = 0.5f * m.w(), h = m.h();
  const MaterialId body = m.plain("plastic", color);
  m.shape.lathe(body, Vec3::Zero(),
                {{0, 0}, {0.82f * r, 0}, {0.82f * r, 0}, {r, h}, {r, h}, {0.95f * r, h}, {0.8f * r, 0.03f}, {0, 0.03f}},
                20);
}

void make_toy_box(FurnitureBuilder& m) {
  const Rgb color = m.fabric_color();
  const MaterialId body = m.plain("wood", color);
  const float hx = 0.5f * m.w(), hz = 0.5f * m.d(), h = 0.6f * m.h();
  m.shape.box(body, {-hx, 0, -hz}, {hx, h, -hz + 0.02f});
  m.shape.box(body, {-hx, 0, hz - 0.02f}, {hx, h, hz});
  for (const float x : {-hx, hx - 0.02f}) m.shape.box(body, {x, 0, -hz}, {x + 0.02f, h, hz});
  m.shape.box(body, {-hx, 0, -hz}, {hx, 0.02f, hz});
  const MaterialId toy = m.plain("plastic", Rgb::Ones());
  for (int i = 0; i < 14; ++i) {
    m.shape.set_tint(oklch(range(m.rng, 0.55f, 0.85f), 0.14f, range(m.rng, 0.f, 360.f)));
    const Vec3 at(range(m.rng, -0.75f, 0.75f) * hx, h - range(m.rng, 0.02f, 0.1f), range(m.rng, -0.6f, 0.6f) * hz);
    if (i % 2 == 0)
      m.shape.ellipsoid(toy, at, Vec3::Constant(range(m.rng, 0.05f, 0.09f)), 12);
    else
      m.shape.soft_box(toy, at - Vec3::Constant(0.05f), at + Vec3::Constant(0.05f), 0.01f, 0.f, 1);
  }
  m.shape.set_tint(Rgb::Ones());
}

}  // namespace wiw::apartment
