// SPDX-License-Identifier: Apache-2.0
#include "wiw/apartment/furniture/furniture.hpp"
#include "wiw/core/intrinsics.hpp"

namespace wiw::apartment {

namespace {

MaterialId upholstery(FurnitureBuilder& m, const Rgb& color) {
  const bool leather = m.rng.chance(0.25);
  m.attributes["material"] = leather ? "leather" : "fabric";
  return m.materials.tinted(leather ? Pattern::kLeather : Pattern::kWeave, color);
}

/// Body shared by sofas and armchairs: plinth, arms, back, seat and back cushions.
void add_sofa_body(FurnitureBuilder& m, int seats) {
  const Rgb color = m.fabric_color();
  const MaterialId cloth = upholstery(m, color);
  const MaterialId legs = m.wood(m.look.wood);
  const float hx = 0.5f * m.w(), hz = 0.5f * m.d(), seat = range(m.rng, 0.40f, 0.45f);
  const float arm = range(m.rng, 0.12f, 0.2f), arm_top = range(m.rng, 0.56f, 0.66f), round = range(m.rng, 0.03f, 0.07f),
              back = 0.2f;
  for (const float x : {-hx + 0.08f, hx - 0.08f}) {
    for (const float z : {-hz + 0.08f, hz - 0.08f})
      m.shape.cylinder(legs, {x, 0, z}, {x, 0.11f, z}, 0.018f, 0.028f, 10);
  }
  m.shape.soft_box(cloth, {-hx + 0.02f, 0.1f, -hz + 0.02f}, {hx - 0.02f, seat - 0.13f, hz - 0.03f}, 0.03f);
  for (const float side : {-1.f, 1.f}) {
    const float a = side < 0 ? -hx : hx - arm;
    m.shape.soft_box(cloth, {a, 0.1f, -hz}, {a + arm, arm_top, hz - 0.02f}, round, 0.f, 3);
  }
  m.shape.soft_box(cloth, {-hx + arm * 0.5f, 0.1f, -hz}, {hx - arm * 0.5f, m.h() - 0.06f, -hz + back}, round, 0.f, 3);
  const float inner = m.w() - 2 * arm, each = inner / static_cast<float>(seats);
  for (int i = 0; i < seats; ++i) {
    const float x = -hx + arm + each * static_cast<float>(i);
    m.shape.soft_box(cloth, {x + 0.004f, seat - 0.14f, -hz + back - 0.02f}, {x + each - 0.004f, seat, hz}, 0.05f,
                     0.025f, 3);
    m.shape.soft_box(cloth, {x + 0.01f, seat - 0.02f, -hz + back - 0.04f},
                     {x + each - 0.01f, m.h(), -hz + back + 0.14f}, 0.06f, 0.02f, 3);
  }
}

void add_throw_pillow(FurnitureBuilder& m, const Rgb& color, float x, float y, float z, float lean) {
  const Eigen::Affine3f before = m.shape.frame();
  m.shape.set_frame(before * Eigen::Translation3f(x, y, z) * Eigen::AngleAxisf(lean, Vec3::UnitY()) *
                    Eigen::AngleAxisf(-1.25f, Vec3::UnitX()));
  m.shape.soft_box(m.fabric(color), {-0.21f, -0.05f, -0.21f}, {0.21f, 0.06f, 0.21f}, 0.05f, 0.035f, 3);
  m.shape.set_frame(before);
}

/// Chair back: 0 board, 1 slats, 2 ladder, 3 padded.
void add_chair_back(FurnitureBuilder& m, MaterialId frame, MaterialId pad, float half, float seat, float back,
                    int style) {
  const float h = m.h();
  const auto lean = [&](float y) { return back - 0.06f * (y - seat) / (h - seat); };
  for (const float x : {-half + 0.02f, half - 0.02f})
    m.shape.tube(frame, {{x, seat - 0.02f, back}, {x, 0.5f * (seat + h), lean(0.5f * (seat + h))}, {x, h, lean(h)}},
                 0.017f);
  if (style == 0 || style == 3) {
    const Eigen::Affine3f before = m.shape.frame();
    m.shape.set_frame(before * Eigen::Translation3f(0, seat + 0.16f, lean(seat + 0.16f)) *
                      Eigen::AngleAxisf(-0.13f, Vec3::UnitX()));
    m.shape.soft_box(style == 3 ? pad : frame, {-half + 0.01f, 0, -0.015f},
                     {half - 0.01f, h - seat - 0.16f, style == 3 ? 0.035f : 0.012f}, 0.014f, 0.f, 2);
    m.shape.set_frame(before);
    return;
  }
  const int bars = style == 1 ? 5 : 3;
  for (int i = 0; i < bars; ++i) {
    if (style == 1) {
      const float x = (static_cast<float>(i) - 2.f) * half * 0.36f;
      m.shape.tube(frame, {{x, seat, back}, {x, h - 0.04f, lean(h - 0.04f)}}, 0.009f, 6);
    } else {
      const float y = seat + (h - seat) * (0.35f + 0.27f * static_cast<float>(i));
      m.shape.box(frame, {-half + 0.02f, y, lean(y) - 0.012f}, {half - 0.02f, y + 0.055f, lean(y) + 0.008f});
    }
  }
  if (style == 1)
    m.shape.soft_box(frame, {-half, h - 0.06f, lean(h) - 0.015f}, {half, h, lean(h) + 0.02f}, 0.012f, 0.f, 1);
}

}  // namespace

void make_sofa(FurnitureBuilder& m) {
  add_sofa_body(m, m.w() > 1.9f ? 3 : 2);
  const int pillows = static_cast<int>(m.rng.below(4));
  for (int i = 0; i < pillows; ++i) {
    const float side = i % 2 == 0 ? -1.f : 1.f;
    const int inward = i / 2;
    add_throw_pillow(m, pick(m.rng, m.look.fabrics), side * (0.5f * m.w() - 0.42f - 0.2f * static_cast<float>(inward)),
                     0.6f, -0.5f * m.d() + 0.4f, -0.35f * side);
  }
}

void make_armchair(FurnitureBuilder& m) {
  add_sofa_body(m, 1);
  if (m.rng.chance(0.5)) add_throw_pillow(m, pick(m.rng, m.look.fabrics), 0.f, 0.6f, -0.5f * m.d() + 0.38f, 0.2f);
}

void make_chair(FurnitureBuilder& m) {
  const Rgb color = m.case_color();
  const MaterialId frame = m.case_material(color), pad = m.fabric(m.look.fabrics[m.rng.below(2)]);
  const float half = 0.5f * m.w() - 0.01f, hz = 0.5f * m.d() - 0.01f, seat = 0.46f;
  const int style = static_cast<int>(m.rng.below(4));
  const bool padded = style == 3 || m.rng.chance(0.4);
  add_legs(m, frame, m.w(), m.d(), seat - 0.02f, 0.034f, static_cast<int>(m.rng.below(3)));
  m.shape.soft_box(frame, {-half, seat - 0.04f, -hz}, {half, seat - 0.005f, hz}, 0.014f, 0.f, 1);
  if (padded)
    m.shape.soft_box(pad, {-half + 0.01f, seat - 0.01f, -hz + 0.02f}, {half - 0.01f, seat + 0.035f, hz - 0.01f}, 0.02f,
                     0.015f, 2);
  add_chair_back(m, frame, pad, half, seat, -hz + 0.02f, style);
}

void make_office_chair(FurnitureBuilder& m) {
  const Rgb color = m.fabric_color();
  const MaterialId cloth = m.fabric(color), dark = m.black(), metal = m.chrome();
  const float half = 0.24f;
  for (int i = 0; i < 5; ++i) {
    const float turn = 1.2566f * static_cast<float>(i);
    const Vec3 tip(0.28f * std::sin(turn), 0.075f, 0.28f * std::cos(turn));
    m.shape.tube(dark, {{0, 0.11f, 0}, 0.6f * tip + Vec3(0, 0.05f, 0), tip}, 0.02f, 6);
    m.shape.ellipsoid(dark, {tip.x(), 0.03f, tip.z()}, {0.03f, 0.03f, 0.03f}, 8);
  }
  m.shape.cylinder(metal, {0, 0.1f, 0}, {0, 0.42f, 0}, 0.03f, 0.025f, 10);
  m.shape.soft_box(cloth, {-half, 0.42f, -half + 0.02f}, {half, 0.51f, half + 0.02f}, 0.04f, 0.01f, 3);
  m.shape.tube(dark, {{0, 0.44f, -0.15f}, {0, 0.46f, -half - 0.04f}, {0, 0.62f, -half - 0.05f}}, 0.025f);
  m.shape.soft_box(cloth, {-half + 0.02f, 0.58f, -half - 0.04f}, {half - 0.02f, m.h(), -half + 0.04f}, 0.038f, 0.f, 3);
  for (const float x : {-half - 0.01f, half + 0.01f}) {
    m.shape.tube(dark, {{x * 0.8f, 0.45f, 0}, {x, 0.5f, 0}, {x, 0.66f, 0}}, 0.014f, 6);
    m.shape.soft_box(dark, {x - 0.03f, 0.65f, -0.12f}, {x + 0.03f, 0.68f, 0.14f}, 0.012f, 0.f, 1);
  }
}

void make_stool(FurnitureBuilder& m) {
  const MaterialId wood = m.case_material(m.case_color());
  const float r = 0.5f * m.w(), h = m.h();
  if (m.rng.chance(0.6)) {
    m.shape.lathe(wood, {0, h - 0.045f, 0},
                  {{0, 0}, {r - 0.01f, 0}, {r, 0.012f}, {r, 0.035f}, {r - 0.012f, 0.045f}, {0, 0.042f}}, 20);
  } else {
    const Rgb color = m.fabric_color();
    m.shape.lathe(m.fabric(color), {0, h - 0.09f, 0},
                  {{0, 0}, {r - 0.01f, 0}, {r, 0.02f}, {r, 0.06f}, {r - 0.03f, 0.085f}, {0, 0.09f}}, 20);
  }
  for (int i = 0; i < 4; ++i) {
    const float turn = 0.7854f + 1.5708f * static_cast<float>(i);
    const Vec3 out(std::sin(turn), 0, std::cos(turn));
    m.shape.cylinder(wood, 0.95f * r * out, 0.6f * r * out + Vec3(0, h - 0.04f, 0), 0.014f, 0.019f, 8);
    const Vec3 next(std::sin(turn + 1.5708f), 0, std::cos(turn + 1.5708f));
    m.shape.cylinder(wood, 0.84f * r * out + Vec3(0, 0.3f * h, 0), 0.84f * r * next + Vec3(0, 0.3f * h, 0), 0.009f,
                     0.009f, 6);
  }
}

void make_bench(FurnitureBuilder& m) {
  const MaterialId wood = m.case_material(m.case_color());
  const float hx = 0.5f * m.w(), hz = 0.5f * m.d();
  add_legs(m, wood, m.w() - 0.06f, m.d(), m.h() - 0.04f, 0.045f, static_cast<int>(m.rng.below(4)));
  m.shape.soft_box(wood, {-hx, m.h() - 0.045f, -hz}, {hx, m.h(), hz}, 0.01f, 0.f, 1);
  if (m.rng.chance(0.6)) {
    const Rgb color = m.fabric_color();
    m.shape.soft_box(m.fabric(color), {-hx + 0.01f, m.h() - 0.005f, -hz + 0.01f},
                     {hx - 0.01f, m.h() + 0.06f, hz - 0.01f}, 0.025f, 0.01f, 2);
  }
}

void make_pouf(FurnitureBuilder& m) {
  const Rgb color = m.fabric_color();
  const float r = 0.5f * m.w(), h = m.h();
  m.shape.lathe(m.fabric(color), Vec3::Zero(),
                {{0, 0.f},
                 {0.8f * r, 0.f},
                 {0.95f * r, 0.18f * h},
                 {r, 0.5f * h},
                 {0.93f * r, 0.84f * h},
                 {0.7f * r, 0.97f * h},
                 {0, h}},
                22);
}

}  // namespace wiw::apartment
