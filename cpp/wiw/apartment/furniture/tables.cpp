// SPDX-License-Identifier: Apache-2.0
#include "wiw/apartment/furniture/furniture.hpp"

namespace wiw::apartment {

void add_legs(FurnitureBuilder& m, MaterialId material, float width, float depth, float top, float thickness, int style,
              const Vec3& center) {
  const float hx = 0.5f * width - thickness * 0.7f, hz = 0.5f * depth - thickness * 0.7f, r = 0.5f * thickness;
  for (const float sx : {-1.f, 1.f}) {
    for (const float sz : {-1.f, 1.f}) {
      const Vec3 foot = center + Vec3(sx * hx, 0, sz * hz);
      const Vec3 head =
          center + Vec3(sx * (hx - (style == 1 ? 0.05f : 0.f)), top, sz * (hz - (style == 1 ? 0.05f : 0.f)));
      if (style == 0 || style == 3) {
        m.shape.box(material, foot - Vec3(r, 0, r), foot + Vec3(r, top, r));
      } else if (style == 1) {
        m.shape.cylinder(material, foot, head, 0.6f * r, r, 10);
      } else {
        m.shape.lathe(material, foot,
                      {{0.7f * r, 0},
                       {0.8f * r, 0.05f * top},
                       {1.1f * r, 0.1f * top},
                       {0.6f * r, 0.15f * top},
                       {r, 0.6f * top},
                       {0.6f * r, 0.78f * top},
                       {1.1f * r, 0.82f * top},
                       {r, top}},
                      10);
      }
    }
    if (style == 3) m.shape.box(material, center + Vec3(sx * hx - r, 0, -hz), center + Vec3(sx * hx + r, 2 * r, hz));
  }
}

namespace {

/// Table top: 0 board with rounded edges, 1 round, 2 board on an apron.
void add_top(FurnitureBuilder& m, MaterialId material, int style, float thickness) {
  const float hx = 0.5f * m.w(), hz = 0.5f * m.d(), h = m.h();
  if (style == 1) {
    m.shape.lathe(material, {0, h - thickness, 0},
                  {{0, 0},
                   {hx - 0.01f, 0},
                   {hx, 0.3f * thickness},
                   {hx, 0.7f * thickness},
                   {hx - 0.008f, thickness},
                   {hx - 0.008f, thickness},
                   {0.5f * hx, thickness},
                   {0, thickness}},
                  32);
    return;
  }
  m.shape.soft_box(material, {-hx, h - thickness, -hz}, {hx, h, hz}, 0.3f * thickness, 0.f, 1);
  if (style == 2)
    m.shape.box(material, {-hx + 0.07f, h - thickness - 0.08f, -hz + 0.07f}, {hx - 0.07f, h - thickness, hz - 0.07f});
}

/// A turned column on a spreading foot.
void add_pedestal(FurnitureBuilder& m, MaterialId material, float top) {
  const float r = 0.3f * std::min(m.w(), m.d());
  m.shape.lathe(material, Vec3::Zero(),
                {{0, 0},
                 {r, 0},
                 {r, 0.025f},
                 {0.85f * r, 0.04f},
                 {0.3f * r, 0.07f},
                 {0.18f * r, 0.2f},
                 {0.16f * r, 0.7f * top},
                 {0.3f * r, top},
                 {0, top}},
                24);
}

}  // namespace

void make_dining_table(FurnitureBuilder& m) {
  const MaterialId wood = m.case_material(m.case_color());
  const bool round = std::abs(m.w() - m.d()) < 0.12f;
  if (round) m.size.z() = m.size.x();
  const int style = round ? 1 : m.rng.chance(0.5) ? 2 : 0;
  add_top(m, wood, style, 0.035f);
  if (round && m.rng.chance(0.7))
    add_pedestal(m, wood, m.h() - 0.03f);
  else if (round)
    add_legs(m, wood, 0.72f * m.w(), 0.72f * m.d(), m.h() - 0.03f, 0.06f, 1);
  else
    add_legs(m, wood, m.w() - 0.04f, m.d() - 0.04f, m.h() - 0.03f, 0.07f, static_cast<int>(m.rng.below(4)));
  m.supports.push_back({{0, m.h(), 0}, {0.34f * m.w(), 0.34f * m.d()}, 0.9f});
}

void make_coffee_table(FurnitureBuilder& m) {
  const MaterialId wood = m.case_material(m.case_color());
  const bool round = m.rng.chance(0.35);
  if (round) m.size.x() = m.size.z() = 0.5f * (m.w() + m.d());
  add_top(m, wood, round ? 1 : 0, 0.03f);
  add_legs(m, wood, (round ? 0.7f : 0.98f) * m.w(), (round ? 0.7f : 0.98f) * m.d(), m.h() - 0.03f, 0.04f,
           static_cast<int>(round ? 1 : m.rng.below(4)));
  if (!round && m.rng.chance(0.5)) {
    m.shape.box(wood, {-0.44f * m.w(), 0.14f, -0.42f * m.d()}, {0.44f * m.w(), 0.155f, 0.42f * m.d()});
    m.supports.push_back({{0, 0.155f, 0}, {0.38f * m.w(), 0.34f * m.d()}, m.h() - 0.24f});
  }
  m.supports.push_back({{0, m.h(), 0}, {0.32f * m.w(), 0.32f * m.d()}, 0.8f});
}

void make_desk(FurnitureBuilder& m) {
  const MaterialId wood = m.case_material(m.case_color());
  const float hx = 0.5f * m.w(), hz = 0.5f * m.d(), h = m.h();
  m.shape.soft_box(wood, {-hx, h - 0.03f, -hz}, {hx, h, hz}, 0.008f, 0.f, 1);
  const bool drawers = m.rng.chance(0.6), right = m.rng.chance(0.5);
  add_legs(m, m.rng.chance(0.5) ? m.black() : wood, m.w(), m.d(), h - 0.03f, 0.04f, static_cast<int>(m.rng.below(4)));
  if (drawers) {
    const float x0 = right ? hx - 0.44f : -hx + 0.05f, x1 = x0 + 0.39f;
    m.shape.box(wood, {x0, 0.08f, -hz + 0.04f}, {x1, h - 0.03f, hz - 0.05f});
    add_fronts(m, wood, m.chrome(), {x0, 0.08f, hz - 0.05f}, {x1, h - 0.035f, hz - 0.03f}, 1, 3, true);
  }
  m.shape.box(wood, {-hx + 0.05f, h - 0.3f, -hz + 0.03f}, {hx - 0.05f, h - 0.03f, -hz + 0.045f});
  m.supports.push_back({{0, h, -0.05f}, {hx - 0.12f, hz - 0.16f}, 0.7f});
}

void make_side_table(FurnitureBuilder& m) {
  const MaterialId wood = m.case_material(m.case_color());
  m.size.z() = m.size.x();
  add_top(m, wood, 1, 0.025f);
  if (m.rng.chance(0.5))
    add_pedestal(m, wood, m.h() - 0.02f);
  else
    add_legs(m, wood, 0.75f * m.w(), 0.75f * m.d(), m.h() - 0.02f, 0.03f, 1);
  m.supports.push_back({{0, m.h(), 0}, {0.28f * m.w(), 0.28f * m.w()}, 0.8f});
}

void make_console(FurnitureBuilder& m) {
  const MaterialId wood = m.case_material(m.case_color());
  add_top(m, wood, 2, 0.03f);
  add_legs(m, wood, m.w(), m.d(), m.h() - 0.03f, 0.04f, static_cast<int>(m.rng.below(4)));
  const float y = 0.18f;
  m.shape.box(wood, {-0.46f * m.w(), y, -0.4f * m.d()}, {0.46f * m.w(), y + 0.02f, 0.4f * m.d()});
  m.supports.push_back({{0, y + 0.02f, 0}, {0.4f * m.w(), 0.3f * m.d()}, 0.4f});
  m.supports.push_back({{0, m.h(), 0}, {0.42f * m.w(), 0.32f * m.d()}, 0.7f});
}

}  // namespace wiw::apartment
