// SPDX-License-Identifier: Apache-2.0
#include "wiw/apartment/furniture/furniture.hpp"

namespace wiw::apartment {

namespace {

void add_pillows(FurnitureBuilder& m, MaterialId cover, float width, float top, float back) {
  const int count = width > 1.2f ? 2 : 1;
  const float each = std::min(0.68f, (width - 0.12f) / static_cast<float>(count));
  for (int i = 0; i < count; ++i) {
    const float x =
        (static_cast<float>(i) - 0.5f * static_cast<float>(count - 1)) * (width / static_cast<float>(count));
    m.shape.soft_box(cover, {x - 0.48f * each, top - 0.02f, back}, {x + 0.48f * each, top + 0.1f, back + 0.42f}, 0.055f,
                     0.05f, 3);
  }
}

/// Quilt that hangs over three sides, turned back at the pillows.
void add_quilt(FurnitureBuilder& m, MaterialId quilt, MaterialId lining, float half, float top, float from,
               float front) {
  m.shape.soft_box(quilt, {-half - 0.025f, top - 0.22f, from}, {half + 0.025f, top + 0.05f, front + 0.02f}, 0.045f,
                   0.02f, 2);
  m.shape.soft_box(lining, {-half - 0.03f, top - 0.16f, from - 0.05f}, {half + 0.03f, top + 0.065f, from + 0.24f},
                   0.04f, 0.f, 2);
}

void add_headboard(FurnitureBuilder& m, MaterialId wood, MaterialId fabric, int style, float back) {
  const float half = 0.5f * m.w(), h = m.h();
  if (style == 0) {
    m.shape.soft_box(wood, {-half, 0.1f, back}, {half, h, back + 0.05f}, 0.02f);
  } else if (style == 1) {  // upholstered in vertical channels
    const int channels = std::max(3, static_cast<int>(m.w() / 0.22f));
    for (int i = 0; i < channels; ++i) {
      const float x = -half + m.w() * static_cast<float>(i) / static_cast<float>(channels);
      m.shape.soft_box(fabric, {x, 0.15f, back}, {x + m.w() / static_cast<float>(channels), h, back + 0.1f}, 0.045f,
                       0.f, 3);
    }
  } else {  // posts, rails and slats
    for (const float side : {-1.f, 1.f})
      m.shape.box(wood, {side * (half - 0.03f) - 0.03f, 0, back}, {side * (half - 0.03f) + 0.03f, h, back + 0.06f});
    for (const float y : {0.42f, h - 0.1f})
      m.shape.box(wood, {-half, y, back + 0.01f}, {half, y + 0.08f, back + 0.05f});
    const int slats = static_cast<int>(m.w() / 0.13f);
    for (int i = 1; i < slats; ++i) {
      const float x = -half + m.w() * static_cast<float>(i) / static_cast<float>(slats);
      m.shape.box(wood, {x - 0.022f, 0.45f, back + 0.02f}, {x + 0.022f, h - 0.08f, back + 0.04f});
    }
  }
}

}  // namespace

void make_bed(FurnitureBuilder& m) {
  const Rgb wood_color = m.case_color();
  const Rgb cover = m.fabric_color();
  const MaterialId wood = m.case_material(wood_color), sheet = m.fabric({0.93f, 0.92f, 0.9f});
  const MaterialId quilt = m.fabric(cover), lining = m.fabric(m.look.fabrics[2]);
  const float half = 0.5f * m.w(), back = -0.5f * m.d(), front = 0.5f * m.d();
  const int style = static_cast<int>(m.rng.below(3));
  const float frame = range(m.rng, 0.28f, 0.34f), top = frame + 0.2f;
  add_headboard(m, wood, quilt, style, back);
  m.shape.soft_box(wood, {-half, frame - 0.16f, back + 0.06f}, {half, frame, front}, 0.015f, 0.f, 1);
  for (const float x : {-half + 0.05f, half - 0.05f}) {
    for (const float z : {back + 0.1f, front - 0.06f})
      m.shape.cylinder(wood, {x, 0, z}, {x, frame - 0.14f, z}, 0.025f, 0.035f, 10);
  }
  m.shape.soft_box(sheet, {-half + 0.03f, frame - 0.02f, back + 0.1f}, {half - 0.03f, top, front - 0.02f}, 0.06f, 0.f,
                   3);
  add_quilt(m, quilt, lining, half - 0.03f, top, back + 0.72f, front - 0.03f);
  add_pillows(m, lining, m.w() - 0.06f, top, back + 0.13f);
  m.attributes["state"] = "made";
}

void make_bunk_bed(FurnitureBuilder& m) {
  const MaterialId wood = m.case_material(m.case_color());
  const Rgb cover = m.fabric_color();
  const MaterialId quilt = m.fabric(cover), sheet = m.fabric({0.93f, 0.92f, 0.9f});
  const float hx = 0.5f * m.w(), hz = 0.5f * m.d(), h = m.h();
  for (const float x : {-hx + 0.035f, hx - 0.035f}) {
    for (const float z : {-hz + 0.035f, hz - 0.035f})
      m.shape.box(wood, {x - 0.035f, 0, z - 0.035f}, {x + 0.035f, h, z + 0.035f});
  }
  for (const float level : {0.3f, h - 0.42f}) {
    m.shape.box(wood, {-hx, level - 0.12f, -hz + 0.01f}, {hx, level, -hz + 0.04f});
    m.shape.box(wood, {-hx, level - 0.12f, hz - 0.04f}, {hx, level, hz - 0.01f});
    m.shape.soft_box(sheet, {-hx + 0.05f, level - 0.04f, -hz + 0.05f}, {hx - 0.05f, level + 0.12f, hz - 0.05f}, 0.05f);
    m.shape.soft_box(quilt, {-hx + 0.55f, level + 0.02f, -hz + 0.04f}, {hx - 0.04f, level + 0.15f, hz - 0.04f}, 0.04f,
                     0.02f);
    m.shape.soft_box(sheet, {-hx + 0.1f, level + 0.1f, -hz + 0.12f}, {-hx + 0.48f, level + 0.2f, hz - 0.12f}, 0.045f,
                     0.03f, 3);
  }
  for (const float y : {h - 0.12f, h - 0.24f})
    m.shape.box(wood, {-hx, y, hz - 0.04f}, {hx - 0.5f, y + 0.07f, hz - 0.015f});
  for (int i = 0; i < 5; ++i) {
    const float y = 0.25f + 0.26f * static_cast<float>(i);
    m.shape.cylinder(wood, {hx - 0.45f, y, hz}, {hx - 0.08f, y, hz}, 0.017f, 0.017f, 8);
  }
  m.shape.box(wood, {hx - 0.47f, 0, hz - 0.02f}, {hx - 0.43f, h, hz + 0.02f});
}

void make_nightstand(FurnitureBuilder& m) {
  const Rgb color = m.case_color();
  const MaterialId wood = m.case_material(color);
  const float hx = 0.5f * m.w(), hz = 0.5f * m.d(), legs = range(m.rng, 0.f, 1.f) < 0.6f ? 0.14f : 0.f;
  const float base = legs > 0.f ? legs : 0.f;
  m.shape.soft_box(wood, {-hx, base, -hz}, {hx, m.h(), hz - 0.02f}, 0.012f, 0.f, 1);
  if (legs > 0.f) add_legs(m, wood, m.w(), m.d(), legs, 0.035f, static_cast<int>(m.rng.below(2)));
  const int rows = static_cast<int>(1 + m.rng.below(3));
  add_fronts(m, wood, m.chrome(), {-hx, base, hz - 0.02f}, {hx, m.h(), hz}, 1, rows, true);
  m.supports.push_back({{0, m.h(), 0}, {hx - 0.04f, hz - 0.05f}, 0.8f});
}

}  // namespace wiw::apartment
