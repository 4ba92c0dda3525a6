// SPDX-License-Identifier: Apache-2.0
#include "wiw/apartment/furniture/furniture.hpp"

namespace wiw::apartment {

Eigen::Affine3f open_leaf(FurnitureBuilder& m, const Vec2& hinge, const Vec3& low, const Vec3& high) {
  constexpr float kAngle = 1.48f;  // 85 degrees: a leaf in a corner stays clear of the wall
  const bool left = hinge.x() < 0.5f * (low.x() + high.x());
  const Vec3 pivot(hinge.x(), 0.f, hinge.y());
  const Eigen::Affine3f turn = Eigen::Translation3f(pivot) * Eigen::AngleAxisf(left ? -kAngle : kAngle, Vec3::UnitY()) *
                               Eigen::Translation3f(-pivot);
  m.leaves.push_back(Eigen::AlignedBox3f(low, high).transformed(turn));
  return turn;
}

void add_fronts(FurnitureBuilder& m, MaterialId front, MaterialId metal, const Vec3& low, const Vec3& high, int columns,
                int rows, bool drawers, int open_columns) {
  const Eigen::Affine3f before = m.shape.frame();
  const int handle = static_cast<int>(m.rng.below(3));
  const float w = (high.x() - low.x()) / static_cast<float>(columns),
              h = (high.y() - low.y()) / static_cast<float>(rows);
  for (int c = 0; c < columns; ++c) {
    for (int r = 0; r < rows; ++r) {
      const Vec3 a = low + Vec3(w * static_cast<float>(c) + 0.004f, h * static_cast<float>(r) + 0.004f, 0.f);
      const Vec3 b(a.x() + w - 0.008f, a.y() + h - 0.008f, high.z());
      const bool hung_left = c % 2 == 0 && columns > 1;
      if (c < open_columns) m.shape.set_frame(before * open_leaf(m, {hung_left ? a.x() : b.x(), high.z()}, a, b));
      m.shape.soft_box(front, a, b, 0.006f, 0.f, 1);
      const float x = drawers ? 0.5f * (a.x() + b.x()) : hung_left ? b.x() - 0.04f : a.x() + 0.04f;
      const float y = drawers ? a.y() + 0.7f * h : (a.y() > 0.9f ? a.y() + 0.12f : std::min(b.y() - 0.14f, 1.05f));
      const Vec3 along = drawers ? Vec3(0.06f, 0, 0) : Vec3(0, 0.06f, 0);
      const Vec3 at(x, y, b.z());
      if (handle == 0)
        m.shape.ellipsoid(metal, at + Vec3(0, 0, 0.016f), {0.014f, 0.014f, 0.016f}, 8);
      else if (handle == 1)
        m.shape.tube(metal, {at - along, at - along + Vec3(0, 0, 0.025f), at + along + Vec3(0, 0, 0.025f), at + along},
                     0.006f, 6);
      else
        m.shape.box(metal, at - along - Vec3(0.004f, 0.004f, 0), at + along + Vec3(0.004f, 0.004f, 0.014f));
      m.shape.set_frame(before);
    }
  }
}

void add_books(FurnitureBuilder& m, float x0, float x1, float y, float z, float clearance, float depth) {
  const MaterialId paper = m.plain("paper", Rgb::Ones());
  const float tall = std::min(clearance - 0.03f, 0.3f);
  float x = x0;
  while (x < x1 - 0.02f) {
    const float thick = range(m.rng, 0.016f, 0.045f), height = tall * range(m.rng, 0.7f, 1.f),
                deep = std::min(depth, height * 0.78f);
    if (x + thick > x1) break;
    m.shape.set_tint(oklch(range(m.rng, 0.3f, 0.85f), range(m.rng, 0.02f, 0.13f), range(m.rng, 0.f, 360.f)));
    m.shape.box(paper, {x, y, z - deep},
                {x + thick - 0.001f, y + height, z - 0.004f * static_cast<float>(m.rng.below(5))});
    x += thick;
  }
  m.shape.set_tint(Rgb::Ones());
}

void add_carcass(FurnitureBuilder& m, MaterialId wood, const Vec3& low, const Vec3& high, float board) {
  m.shape.box(wood, low, {low.x() + board, high.y(), high.z()});
  m.shape.box(wood, {high.x() - board, low.y(), low.z()}, high);
  m.shape.box(wood, {low.x() + board, low.y(), low.z()}, {high.x() - board, low.y() + board, high.z()});
  m.shape.box(wood, {low.x() + board, high.y() - board, low.z()}, {high.x() - board, high.y(), high.z()});
  m.shape.box(wood, {low.x() + board, low.y() + board, low.z()},
              {high.x() - board, high.y() - board, low.z() + 0.008f});
}

namespace {

/// Clothes on a rail across the case, and folded linen below.
void add_clothes(FurnitureBuilder& m, const Vec3& low, const Vec3& high) {
  const float rail = high.y() - 0.09f, z = 0.5f * (low.z() + high.z());
  m.shape.tube(m.chrome(), {{low.x(), rail, z}, {high.x(), rail, z}}, 0.011f, 8);
  const MaterialId cloth = m.fabric(Rgb::Ones());
  float x = low.x() + 0.05f;
  while (x < high.x() - 0.1f) {
    m.shape.set_tint(oklch(range(m.rng, 0.3f, 0.85f), range(m.rng, 0.02f, 0.13f), range(m.rng, 0.f, 360.f)));
    const float bottom = std::max(low.y() + 0.25f, rail - range(m.rng, 0.6f, 1.f));
    m.shape.soft_box(cloth, {x, bottom, z - 0.19f}, {x + 0.045f, rail - 0.02f, z + 0.19f}, 0.02f, 0.f, 1);
    x += range(m.rng, 0.07f, 0.16f);
  }
  for (const float pile : {0.25f, 0.7f}) {
    const float middle = low.x() + pile * (high.x() - low.x());
    m.shape.set_tint(oklch(range(m.rng, 0.5f, 0.9f), range(m.rng, 0.02f, 0.1f), range(m.rng, 0.f, 360.f)));
    m.shape.soft_box(cloth, {middle - 0.14f, low.y(), z - 0.16f}, {middle + 0.14f, low.y() + 0.14f, z + 0.16f}, 0.03f,
                     0.f, 1);
  }
  m.shape.set_tint(Rgb::Ones());
}

/// Fills a shelf board with books, a gap and perhaps an ornament's place.
void fill_shelf(FurnitureBuilder& m, float x0, float x1, float y, float z, float clearance, float depth) {
  const double kind = m.rng.uniform();
  const float middle = x0 + (x1 - x0) * range(m.rng, 0.35f, 0.75f);
  if (kind < 0.55)
    add_books(m, x0 + 0.01f, middle, y, z, clearance, depth);
  else if (kind < 0.8)
    add_books(m, middle, x1 - 0.01f, y, z, clearance, depth);
  const float a = kind < 0.55 ? middle + 0.03f : x0, b = kind < 0.55 ? x1 : kind < 0.8 ? middle - 0.03f : x1;
  if (b - a > 0.16f)
    m.supports.push_back({{0.5f * (a + b), y, z - 0.5f * depth}, {0.5f * (b - a) - 0.03f, 0.25f * depth}, clearance});
}

}  // namespace

void make_wardrobe(FurnitureBuilder& m) {
  const Rgb color = m.case_color();
  const MaterialId wood = m.case_material(color);
  const float hx = 0.5f * m.w(), hz = 0.5f * m.d(), h = m.h();
  const int doors = std::max(2, static_cast<int>(std::lround(m.w() / 0.5f)));
  const bool open = m.state == "open";
  if (open)
    add_carcass(m, wood, {-hx, 0.06f, -hz}, {hx, h, hz - 0.022f}, 0.022f);
  else
    m.shape.box(wood, {-hx, 0.06f, -hz}, {hx, h, hz - 0.022f});
  m.shape.box(wood, {-hx + 0.02f, 0, -hz + 0.02f}, {hx - 0.02f, 0.06f, hz - 0.05f});
  if (m.rng.chance(0.4))
    m.shape.soft_box(wood, {-hx - 0.02f, h, -hz}, {hx + 0.02f, h + 0.05f, hz + 0.02f}, 0.015f, 0.f, 2);
  const bool drawers = m.rng.chance(0.4);
  const float split = drawers ? 0.5f : 0.07f;
  if (drawers)
    add_fronts(m, wood, m.chrome(), {-hx, 0.07f, hz - 0.022f}, {hx, split, hz}, doors / 2 + doors % 2, 1, true);
  add_fronts(m, wood, m.chrome(), {-hx, split, hz - 0.022f}, {hx, h, hz}, doors, 1, false, open ? 2 : 0);
  if (m.rng.chance(0.3)) {
    const float w = m.w() / static_cast<float>(doors);
    const Eigen::Affine3f before = m.shape.frame();
    if (open)  // on the second door
      m.shape.set_frame(before *
                        open_leaf(m, {-hx + 2.f * w - 0.004f, hz}, {-hx + w, split, hz}, {-hx + 2.f * w, h, hz}));
    m.shape.box(m.plain("mirror", {0.75f, 0.8f, 0.83f}), {-hx + w * 1.f + 0.05f, split + 0.12f, hz},
                {-hx + w * 2.f - 0.06f, h - 0.12f, hz + 0.003f});
    m.shape.set_frame(before);
  }
  if (open) {
    if (drawers) m.shape.box(wood, {-hx + 0.022f, 0.08f, -hz + 0.01f}, {hx - 0.022f, split, hz - 0.03f});
    add_clothes(m, {-hx + 0.022f, drawers ? split : 0.082f, -hz + 0.01f}, {hx - 0.022f, h - 0.022f, hz - 0.03f});
  }
  m.attributes["state"] = open ? "open" : "closed";
}

void make_bookshelf(FurnitureBuilder& m) {
  const Rgb color = m.case_color();
  const MaterialId wood = m.case_material(color);
  const float hx = 0.5f * m.w(), hz = 0.5f * m.d(), board = 0.022f;
  add_carcass(m, wood, {-hx, 0, -hz}, {hx, m.h(), hz}, board);
  const int shelves = std::max(2, static_cast<int>(m.h() / 0.36f));
  const float step = (m.h() - board) / static_cast<float>(shelves);
  const int columns = m.w() > 1.1f ? 2 : 1;
  for (int s = 0; s < shelves; ++s) {
    const float y = board + step * static_cast<float>(s);
    if (s > 0) m.shape.box(wood, {-hx + board, y - board, -hz + 0.008f}, {hx - board, y, hz - 0.005f});
    for (int c = 0; c < columns; ++c) {
      const float w = (m.w() - 2 * board) / static_cast<float>(columns), x = -hx + board + w * static_cast<float>(c);
      fill_shelf(m, x, x + w - (c + 1 < columns ? board : 0.f), y, hz - 0.02f, step - board, m.d() - 0.05f);
    }
  }
  if (columns == 2) m.shape.box(wood, {-0.5f * board, board, -hz + 0.008f}, {0.5f * board, m.h() - board, hz - 0.005f});
}

void make_dresser(FurnitureBuilder& m) {
  const MaterialId wood = m.case_material(m.case_color());
  const float hx = 0.5f * m.w(), hz = 0.5f * m.d(), base = 0.1f;
  m.shape.soft_box(wood, {-hx, m.h() - 0.03f, -hz}, {hx, m.h(), hz + 0.01f}, 0.008f, 0.f, 1);
  m.shape.box(wood, {-hx + 0.01f, base, -hz}, {hx - 0.01f, m.h() - 0.03f, hz - 0.02f});
  add_legs(m, wood, m.w() - 0.02f, m.d() - 0.02f, base, 0.05f, static_cast<int>(m.rng.below(3)));
  add_fronts(m, wood, m.chrome(), {-hx + 0.015f, base, hz - 0.02f}, {hx - 0.015f, m.h() - 0.035f, hz},
             m.w() > 0.95f ? 2 : 1, static_cast<int>(3 + m.rng.below(2)), true);
  m.supports.push_back({{0, m.h(), 0}, {hx - 0.06f, hz - 0.08f}, 0.8f});
}

void make_sideboard(FurnitureBuilder& m) {
  const MaterialId wood = m.case_material(m.case_color());
  const float hx = 0.5f * m.w(), hz = 0.5f * m.d(), base = 0.15f;
  m.shape.soft_box(wood, {-hx, base, -hz}, {hx, m.h(), hz - 0.02f}, 0.008f, 0.f, 1);
  add_legs(m, wood, m.w() - 0.1f, m.d() - 0.04f, base, 0.045f, static_cast<int>(m.rng.below(2)));
  const int columns = std::max(2, static_cast<int>(m.w() / 0.48f));
  const float cut = m.rng.chance(0.5) ? 0.f : 0.3f;
  const float x = -hx + cut * m.w();
  if (cut > 0.f)
    add_fronts(m, wood, m.chrome(), {-hx + 0.01f, base + 0.01f, hz - 0.02f}, {x, m.h() - 0.02f, hz}, 1, 3, true);
  add_fronts(m, wood, m.chrome(), {x + 0.005f, base + 0.01f, hz - 0.02f}, {hx - 0.01f, m.h() - 0.02f, hz},
             columns - (cut > 0.f ? 1 : 0), 1, false);
  m.supports.push_back({{0, m.h(), 0}, {hx - 0.06f, hz - 0.08f}, 0.8f});
}

void make_tv_stand(FurnitureBuilder& m) {
  const MaterialId wood = m.case_material(m.case_color());
  const float hx = 0.5f * m.w(), hz = 0.5f * m.d(), base = 0.1f, board = 0.025f;
  add_carcass(m, wood, {-hx, base, -hz}, {hx, m.h(), hz}, board);
  add_legs(m, wood, m.w() - 0.1f, m.d() - 0.04f, base, 0.04f, static_cast<int>(m.rng.below(2)));
  const float side = 0.3f * m.w();
  for (const float x : {-hx, hx - side})
    add_fronts(m, wood, m.chrome(), {x + board, base + board, hz - 0.02f}, {x + side, m.h() - board, hz - 0.002f}, 1, 1,
               false);
  m.shape.box(m.black(), {-0.16f * m.w(), base + board, -hz + 0.06f}, {0.1f * m.w(), base + board + 0.06f, hz - 0.06f});
  m.supports.push_back({{0, m.h(), 0.03f}, {hx - 0.06f, hz - 0.08f}, 0.9f});
}

void make_shoe_rack(FurnitureBuilder& m) {
  const MaterialId wood = m.case_material(m.case_color());
  const float hx = 0.5f * m.w(), hz = 0.5f * m.d();
  for (const float x : {-hx, hx - 0.025f}) m.shape.box(wood, {x, 0, -hz}, {x + 0.025f, m.h(), hz});
  const MaterialId shoe = m.plain("leather", Rgb::Ones());
  for (const float y : {0.06f, 0.5f * m.h(), m.h() - 0.025f}) {
    m.shape.box(wood, {-hx, y, -hz}, {hx, y + 0.022f, hz});
    if (y > m.h() - 0.1f) continue;
    // Rounding may add or drop a step; none is needed.
    // NOLINTNEXTLINE(bugprone-float-loop-counter,clang-analyzer-security.FloatLoopCounter)
    for (float x = -hx + 0.1f; x < hx - 0.12f; x += 0.24f) {
      if (m.rng.chance(0.3)) continue;
      m.shape.set_tint(oklch(range(m.rng, 0.25f, 0.8f), range(m.rng, 0.02f, 0.12f), range(m.rng, 0.f, 360.f)));
      for (const float side : {0.f, 0.1f}) {
        m.shape.ellipsoid(shoe, {x + side, y + 0.055f, -0.01f}, {0.042f, 0.035f, 0.12f}, 10);
        m.shape.ellipsoid(shoe, {x + side, y + 0.085f, -0.06f}, {0.037f, 0.05f, 0.06f}, 8);
      }
    }
  }
  m.shape.set_tint(Rgb::Ones());
  m.supports.push_back({{0, m.h(), 0}, {hx - 0.06f, hz - 0.06f}, 0.5f});
}

void make_coat_rack(FurnitureBuilder& m) {
  const MaterialId wood = m.case_material(m.case_color());
  const float hx = 0.5f * m.w();
  m.shape.soft_box(wood, {-hx, m.h() - 0.1f, -0.5f * m.d()}, {hx, m.h(), -0.5f * m.d() + 0.025f}, 0.008f, 0.f, 1);
  const int hooks = std::max(3, static_cast<int>(m.w() / 0.18f));
  for (int i = 0; i < hooks; ++i) {
    const float x = -hx + m.w() * (static_cast<float>(i) + 0.5f) / static_cast<float>(hooks),
                z = -0.5f * m.d() + 0.025f, y = m.h() - 0.06f;
    m.shape.tube(m.chrome(), {{x, y, z}, {x, y - 0.01f, z + 0.05f}, {x, y + 0.03f, z + 0.065f}}, 0.006f, 6);
    if (m.rng.chance(0.45)) {
      m.shape.set_tint(oklch(range(m.rng, 0.3f, 0.75f), range(m.rng, 0.03f, 0.13f), range(m.rng, 0.f, 360.f)));
      m.shape.drape(m.fabric(Rgb::Ones()), {x - 0.13f, y - 0.85f, z + 0.005f}, {x + 0.13f, y - 0.03f, z + 0.13f}, 2);
      m.shape.set_tint(Rgb::Ones());
    }
  }
}

void make_wall_shelf(FurnitureBuilder& m) {
  const MaterialId wood = m.case_material(m.case_color());
  const float hx = 0.5f * m.w(), hz = 0.5f * m.d();
  const int boards = m.h() > 0.4f ? 2 : 1;
  for (int i = 0; i < boards; ++i) {
    const float y = m.h() * static_cast<float>(i) / 2.f;
    m.shape.soft_box(wood, {-hx, y, -hz}, {hx, y + 0.028f, hz}, 0.005f, 0.f, 1);
    for (const float x : {-hx + 0.12f, hx - 0.12f})
      m.shape.box(m.black(), {x - 0.008f, y - 0.1f, -hz}, {x + 0.008f, y, hz - 0.05f});
    fill_shelf(m, -hx + 0.03f, hx - 0.03f, y + 0.028f, hz - 0.02f, 0.3f, m.d() - 0.03f);
  }
}

}  // namespace wiw::apartment
