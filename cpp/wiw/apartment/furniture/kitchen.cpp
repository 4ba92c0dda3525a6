// SPDX-License-Identifier: Apache-2.0
#include <array>

#include "wiw/apartment/furniture/furniture.hpp"

namespace wiw::apartment {

namespace {

constexpr float kPlinth = 0.1f, kWorktop = 0.035f;

struct KitchenStyle {
  MaterialId front, carcass, top;
};

/// One style a room: the random stream is the room's, not the piece's.
KitchenStyle kitchen_style(FurnitureBuilder& m) {
  const Rgb color = m.look.fabrics[0];
  const bool painted = color.x() + color.z() > 1.05f;
  const Rgb front = painted ? color : m.look.wood;
  m.describe(front, painted ? "lacquer" : "wood");
  const Rgb stone = m.look.fabrics[2];
  return {painted ? m.plain("lacquer", front) : m.wood(front), m.plain("wood", {0.9f, 0.9f, 0.88f}),
          m.materials.covering(Pattern::kTerrazzo, {0.8f * stone, 0.65f * stone, 0.9f * stone, 0.5f * stone},
                               {0.5f, 0.5f}, "stone", 5)};
}

void add_base(FurnitureBuilder& m, const KitchenStyle& style, int columns, int rows, bool drawers) {
  const float hx = 0.5f * m.w(), hz = 0.5f * m.d(), top = m.h() - kWorktop;
  m.shape.box(style.carcass, {-hx, kPlinth, -hz}, {hx, top, hz - 0.04f});
  m.shape.box(m.black(), {-hx, 0, -hz}, {hx, kPlinth, hz - 0.09f});
  add_fronts(m, style.front, m.chrome(), {-hx, kPlinth, hz - 0.04f}, {hx, top - 0.004f, hz - 0.02f}, columns, rows,
             drawers);
}

void add_worktop(FurnitureBuilder& m, MaterialId top) {
  m.shape.soft_box(top, {-0.5f * m.w(), m.h() - kWorktop, -0.5f * m.d()}, {0.5f * m.w(), m.h(), 0.5f * m.d()}, 0.006f,
                   0.f, 1);
}

}  // namespace

void make_counter(FurnitureBuilder& m) {
  const KitchenStyle style = kitchen_style(m);
  const bool drawers = m.rng.chance(0.5);
  add_base(m, style, m.w() > 0.75f ? 2 : 1, drawers ? 3 : 1, drawers);
  add_worktop(m, style.top);
  m.supports.push_back({{0, m.h(), -0.03f}, {0.5f * m.w() - 0.1f, 0.5f * m.d() - 0.16f}, 0.45f});
}

void make_kitchen_sink(FurnitureBuilder& m) {
  const KitchenStyle style = kitchen_style(m);
  add_base(m, style, m.w() > 0.75f ? 2 : 1, 1, false);
  const MaterialId steel = m.materials.tinted(Pattern::kBrushed, {0.8f, 0.81f, 0.82f});
  const float hx = 0.5f * m.w(), hz = 0.5f * m.d(), h = m.h(), bx = std::min(0.26f, hx - 0.07f), bz = 0.19f;
  // Worktop around the basin, then the basin's four sides and bottom seen from above.
  m.shape.box(style.top, {-hx, h - kWorktop, -hz}, {hx, h, -bz});
  m.shape.box(style.top, {-hx, h - kWorktop, bz}, {hx, h, hz});
  m.shape.box(style.top, {-hx, h - kWorktop, -bz}, {-bx, h, bz});
  m.shape.box(style.top, {bx, h - kWorktop, -bz}, {hx, h, bz});
  const float b = h - 0.17f;
  m.shape.quad(steel, {-bx, b, bz}, {2 * bx, 0, 0}, {0, 0, -2 * bz});
  m.shape.quad(steel, {-bx, b, -bz}, {2 * bx, 0, 0}, {0, 0.175f, 0});
  m.shape.quad(steel, {bx, b, bz}, {-2 * bx, 0, 0}, {0, 0.175f, 0});
  m.shape.quad(steel, {-bx, b, bz}, {0, 0, -2 * bz}, {0, 0.175f, 0});
  m.shape.quad(steel, {bx, b, -bz}, {0, 0, 2 * bz}, {0, 0.175f, 0});
  m.shape.tube(m.chrome(),
               {{0, h, -bz - 0.05f},
                {0, h + 0.22f, -bz - 0.05f},
                {0, h + 0.28f, -bz - 0.02f},
                {0, h + 0.29f, -bz + 0.05f},
                {0, h + 0.24f, -bz + 0.11f}},
               0.011f, 8);
  m.shape.cylinder(m.chrome(), {0.06f, h, -bz - 0.05f}, {0.06f, h + 0.05f, -bz - 0.05f}, 0.014f, 0.012f, 8);
  m.supports.push_back({{hx - 0.08f, h, -0.1f}, {0.03f, 0.08f}, 0.4f});
}

void make_stove(FurnitureBuilder& m) {
  const bool steel = m.rng.chance(0.5);
  const Rgb color = steel ? Rgb(0.7f, 0.71f, 0.72f) : Rgb(0.93f, 0.93f, 0.92f);
  m.describe(color, steel ? "metal" : "enamel");
  const MaterialId body = steel ? m.materials.tinted(Pattern::kBrushed, color) : m.plain("enamel", color);
  const float hx = 0.5f * m.w(), hz = 0.5f * m.d(), h = m.h();
  m.shape.soft_box(body, {-hx, 0.02f, -hz}, {hx, h, hz - 0.02f}, 0.008f, 0.f, 1);
  m.shape.soft_box(m.plain("glass", {0.06f, 0.06f, 0.07f}), {-hx + 0.06f, 0.3f, hz - 0.025f},
                   {hx - 0.06f, 0.66f, hz - 0.008f}, 0.008f, 0.f, 1);
  m.shape.tube(m.chrome(),
               {{-hx + 0.08f, 0.71f, hz - 0.02f},
                {-hx + 0.08f, 0.71f, hz + 0.01f},
                {hx - 0.08f, 0.71f, hz + 0.01f},
                {hx - 0.08f, 0.71f, hz - 0.02f}},
               0.009f, 8);
  m.shape.box(m.plain("glass", {0.09f, 0.09f, 0.1f}), {-hx + 0.015f, h, -hz + 0.02f},
              {hx - 0.015f, h + 0.006f, hz - 0.05f});
  for (const float x : {-0.14f, 0.14f}) {
    for (const float z : {-0.14f, 0.12f}) {
      m.shape.lathe(m.plain("metal", {0.3f, 0.3f, 0.31f}), {x, h + 0.006f, z},
                    {{0.07f, 0}, {0.085f, 0.004f}, {0.085f, 0.008f}, {0.06f, 0.01f}, {0, 0.01f}}, 18);
    }
  }
  for (int i = 0; i < 5; ++i) {
    const float x = -0.2f + 0.1f * static_cast<float>(i);
    m.shape.cylinder(m.chrome(), {x, h - 0.07f, hz - 0.022f}, {x, h - 0.07f, hz + 0.004f}, 0.019f, 0.016f, 10);
  }
  if (m.rng.chance(0.5)) {
    const MaterialId pot = m.plain("enamel", m.look.fabrics[1]);
    m.shape.lathe(pot, {-0.14f, h + 0.016f, 0.12f},
                  {{0, 0},
                   {0.095f, 0},
                   {0.1f, 0.01f},
                   {0.1f, 0.12f},
                   {0.105f, 0.125f},
                   {0.095f, 0.135f},
                   {0.04f, 0.155f},
                   {0, 0.158f}},
                  20);
    m.shape.ellipsoid(m.black(), {-0.14f, h + 0.185f, 0.12f}, {0.018f, 0.015f, 0.018f}, 8);
  }
  m.attributes["state"] = "off";
}

namespace {

/// Hollow case with a white lining, shelves and groceries.
void add_larder(FurnitureBuilder& m, MaterialId body, const Vec3& low, const Vec3& high) {
  constexpr float kWall = 0.045f;
  add_carcass(m, body, low, high, kWall);
  const MaterialId lining = m.plain("plastic", {0.96f, 0.97f, 0.97f});
  const Vec3 a = low + Vec3(kWall, kWall, 0.01f), b(high.x() - kWall, high.y() - kWall, high.z());
  const Vec3 across(b.x() - a.x(), 0, 0), up(0, b.y() - a.y(), 0), deep(0, 0, b.z() - a.z());
  const float lift = 0.002f;
  m.shape.quad(lining, a + Vec3(0, 0, lift), across, up);
  m.shape.quad(lining, a + deep + Vec3(lift, 0, 0), -deep, up);
  m.shape.quad(lining, a + across - Vec3(lift, 0, 0), deep, up);
  m.shape.quad(lining, a + deep + Vec3(0, lift, 0), across, -deep);
  m.shape.quad(lining, a + up - Vec3(0, lift, 0), across, deep);
  const MaterialId glass = m.plain("glass", {0.8f, 0.87f, 0.88f}), grocery = m.plain("plastic", Rgb::Ones());
  const int shelves = std::max(2, static_cast<int>(up.y() / 0.3f));
  for (int s = 0; s < shelves; ++s) {
    const float y = a.y() + up.y() * static_cast<float>(s) / static_cast<float>(shelves);
    if (s > 0) m.shape.box(glass, {a.x(), y - 0.008f, a.z()}, {b.x(), y, b.z() - 0.06f});
    // NOLINTNEXTLINE(bugprone-float-loop-counter,clang-analyzer-security.FloatLoopCounter)
    for (float x = a.x() + 0.08f; x < b.x() - 0.06f; x += range(m.rng, 0.11f, 0.18f)) {
      m.shape.set_tint(oklch(range(m.rng, 0.5f, 0.9f), range(m.rng, 0.04f, 0.15f), range(m.rng, 0.f, 360.f)));
      const float tall = range(m.rng, 0.08f, 0.2f), z = b.z() - range(m.rng, 0.13f, 0.2f);
      if (m.rng.chance(0.5))
        m.shape.cylinder(grocery, {x, y, z}, {x, y + tall, z}, 0.036f, 0.03f, 12);
      else
        m.shape.soft_box(grocery, {x - 0.04f, y, z - 0.05f}, {x + 0.04f, y + tall, z + 0.04f}, 0.006f, 0.f, 1);
    }
  }
  m.shape.set_tint(Rgb::Ones());
}

}  // namespace

void make_refrigerator(FurnitureBuilder& m) {
  const double kind = m.rng.uniform();
  const Rgb color = kind < 0.4 ? Rgb(0.94f, 0.94f, 0.94f) : kind < 0.75 ? Rgb(0.68f, 0.69f, 0.71f) : m.look.fabrics[1];
  m.describe(color, "metal");
  const MaterialId body =
      kind < 0.4 || kind >= 0.75 ? m.plain("metal", color) : m.materials.tinted(Pattern::kBrushed, color);
  const float hx = 0.5f * m.w(), hz = 0.5f * m.d(), h = m.h(), cut = m.rng.chance(0.5) ? 0.62f * h : 0.38f * h;
  const float x = m.rng.chance(0.5) ? -hx + 0.06f : hx - 0.06f;
  const bool open = m.state == "open", lower = cut > 0.5f * h;  // the larger door opens
  struct Door {
    float y0, y1, handle0, handle1;
    bool open;
  };
  const std::array<Door, 2> doors{{{0.05f, cut - 0.004f, cut - 0.45f, cut - 0.06f, open && lower},
                                   {cut + 0.004f, h, cut + 0.06f, cut + 0.36f, open && !lower}}};
  if (!open) m.shape.soft_box(body, {-hx, 0.04f, -hz}, {hx, h, hz - 0.06f}, 0.012f, 0.f, 1);
  if (open && lower) m.shape.soft_box(body, {-hx, cut, -hz}, {hx, h, hz - 0.06f}, 0.012f, 0.f, 1);
  if (open && !lower) m.shape.soft_box(body, {-hx, 0.04f, -hz}, {hx, cut, hz - 0.06f}, 0.012f, 0.f, 1);
  const Eigen::Affine3f before = m.shape.frame();
  Eigen::Affine3f turned = before;
  if (open) {
    const Door& door = doors[lower ? 0 : 1];
    turned = before * open_leaf(m, {x < 0.f ? hx : -hx, hz}, {-hx, door.y0, hz - 0.055f}, {hx, door.y1, hz});
  }
  for (const Door& door : doors) {
    m.shape.set_frame(door.open ? turned : before);
    m.shape.soft_box(body, {-hx, door.y0, hz - 0.055f}, {hx, door.y1, hz}, 0.018f);
  }
  for (const Door& door : doors) {
    m.shape.set_frame(door.open ? turned : before);
    m.shape.tube(
        m.chrome(),
        {{x, door.handle0, hz}, {x, door.handle0, hz + 0.035f}, {x, door.handle1, hz + 0.035f}, {x, door.handle1, hz}},
        0.01f, 8);
  }
  m.shape.set_frame(before);
  if (open) add_larder(m, body, {-hx, lower ? 0.04f : cut, -hz}, {hx, lower ? cut : h, hz - 0.06f});
  m.attributes["state"] = open ? "open" : "closed";
}

namespace {

/// Plates and jars on two boards.
void add_crockery(FurnitureBuilder& m, MaterialId board, const Vec3& low, const Vec3& high) {
  const float middle = 0.5f * (low.y() + high.y()), z = 0.5f * (low.z() + high.z());
  m.shape.box(board, {low.x(), middle - 0.016f, low.z()}, {high.x(), middle, high.z()});
  const MaterialId glaze = m.plain("ceramic", Rgb::Ones());
  for (const float y : {low.y(), middle}) {
    // NOLINTNEXTLINE(bugprone-float-loop-counter,clang-analyzer-security.FloatLoopCounter)
    for (float x = low.x() + 0.1f; x < high.x() - 0.07f; x += range(m.rng, 0.16f, 0.22f)) {
      m.shape.set_tint(oklch(range(m.rng, 0.6f, 0.95f), range(m.rng, 0.01f, 0.12f), range(m.rng, 0.f, 360.f)));
      const float tall = range(m.rng, 0.06f, 0.2f);
      m.shape.lathe(glaze, {x, y, z}, {{0, 0}, {0.055f, 0}, {0.07f, tall}, {0.06f, tall}, {0, 0.8f * tall}}, 16);
    }
  }
  m.shape.set_tint(Rgb::Ones());
}

}  // namespace

void make_wall_cabinet(FurnitureBuilder& m) {
  const KitchenStyle style = kitchen_style(m);
  const float hx = 0.5f * m.w(), hz = 0.5f * m.d();
  const int columns = m.w() > 0.75f ? 2 : 1;
  const bool open = m.state == "open";
  if (open)
    add_carcass(m, style.carcass, {-hx, 0, -hz}, {hx, m.h(), hz - 0.02f}, 0.018f);
  else
    m.shape.box(style.carcass, {-hx, 0, -hz}, {hx, m.h(), hz - 0.02f});
  add_fronts(m, style.front, m.chrome(), {-hx, 0, hz - 0.02f}, {hx, m.h(), hz}, columns, 1, false, open ? columns : 0);
  if (open)
    add_crockery(m, style.carcass, {-hx + 0.018f, 0.018f, -hz + 0.01f}, {hx - 0.018f, m.h() - 0.018f, hz - 0.03f});
  m.attributes["state"] = open ? "open" : "closed";
}

void make_range_hood(FurnitureBuilder& m) {
  const MaterialId steel = m.materials.tinted(Pattern::kBrushed, {0.74f, 0.75f, 0.76f});
  m.describe({0.74f, 0.75f, 0.76f}, "metal");
  const float hx = 0.5f * m.w(), hz = 0.5f * m.d(), back = -hz;
  m.shape.box(steel, {-hx, 0, back}, {hx, 0.06f, hz});
  constexpr float kFlue = 0.13f;
  m.shape.prism(steel, {{-hx, 0.06f}, {hx, 0.06f}, {kFlue, 0.26f}, {-kFlue, 0.26f}}, back, back + 0.26f);
  m.shape.box(steel, {-kFlue, 0.26f, back}, {kFlue, m.h(), back + 0.24f});
}

}  // namespace wiw::apartment
