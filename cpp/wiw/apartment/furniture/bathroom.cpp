// SPDX-License-Identifier: Apache-2.0
#include "wiw/apartment/furniture/furniture.hpp"

namespace wiw::apartment {

namespace {

constexpr float kTurn = 6.2831853f;

/// Squircle bowl or tub: rings of superellipse shape given as (half x, half z, y, z offset).
struct Ring {
  float hx, hz, y, z;
};

void add_rings(FurnitureBuilder& m, MaterialId material, const std::vector<Ring>& rings, float power,
               int segments = 24) {
  for (std::size_t i = 0; i + 1 < rings.size(); ++i) {
    // Each band is its own strip of quads, so that edges between bands stay crisp.
    for (int s = 0; s < segments; ++s) {
      const auto at = [&](const Ring& r, int k) {
        const float turn = kTurn * static_cast<float>(k) / static_cast<float>(segments);
        const auto super = [&](float c) { return std::copysign(std::pow(std::abs(c), 2.f / power), c); };
        return Vec3(r.hx * super(std::sin(turn)), r.y, r.z + r.hz * super(std::cos(turn)));
      };
      m.shape.patch(material, at(rings[i], s), at(rings[i], s + 1), at(rings[i + 1], s + 1), at(rings[i + 1], s));
    }
  }
}

void add_tap(FurnitureBuilder& m, const Vec3& base, float height, float reach) {
  m.shape.cylinder(m.chrome(), base, base + Vec3(0, 0.02f, 0), 0.024f, 0.022f, 12);
  m.shape.tube(m.chrome(),
               {base, base + Vec3(0, height, 0), base + Vec3(0, height + 0.02f, 0.3f * reach),
                base + Vec3(0, height, 0.8f * reach), base + Vec3(0, height - 0.03f, reach)},
               0.012f, 8);
  m.shape.tube(
      m.chrome(),
      {base + Vec3(0, height, 0), base + Vec3(0, height + 0.045f, -0.01f), base + Vec3(0, height + 0.05f, 0.05f)},
      0.007f, 6);
}

}  // namespace

void make_toilet(FurnitureBuilder& m) {
  const MaterialId white = m.white();
  m.describe({0.94f, 0.94f, 0.93f}, "ceramic");
  const float hz = 0.5f * m.d(), z = 0.1f;
  m.shape.soft_box(white, {-0.19f, 0.38f, -hz}, {0.19f, 0.76f, -hz + 0.17f}, 0.03f);
  m.shape.soft_box(white, {-0.2f, 0.76f, -hz - 0.005f + 0.005f}, {0.2f, 0.79f, -hz + 0.18f}, 0.014f);
  m.shape.cylinder(m.chrome(), {0, 0.79f, -hz + 0.09f}, {0, 0.797f, -hz + 0.09f}, 0.022f, 0.02f, 10);
  add_rings(m, white,
            {{0.12f, 0.2f, 0.f, -0.04f},
             {0.11f, 0.19f, 0.14f, -0.04f},
             {0.13f, 0.22f, 0.26f, 0.f},
             {0.175f, 0.23f, 0.36f, z - 0.06f},
             {0.18f, 0.235f, 0.395f, z - 0.06f}},
            2.4f);
  m.shape.soft_box(white, {-0.13f, 0.15f, -hz + 0.02f}, {0.13f, 0.39f, -hz + 0.3f}, 0.03f);
  const bool open = m.draw_open(0.3);
  const MaterialId seat = m.plain("plastic", m.rng.chance(0.8) ? Rgb(0.95f, 0.95f, 0.94f) : m.look.wood);
  if (open) {
    add_rings(m, white,
              {{0.18f, 0.235f, 0.395f, z - 0.06f},
               {0.14f, 0.19f, 0.4f, z - 0.05f},
               {0.1f, 0.14f, 0.28f, z - 0.05f},
               {0.03f, 0.04f, 0.22f, z - 0.06f},
               {0.f, 0.f, 0.22f, z - 0.06f}},
              2.4f);
    add_rings(m, seat,
              {{0.19f, 0.24f, 0.4f, z - 0.06f},
               {0.19f, 0.24f, 0.42f, z - 0.06f},
               {0.125f, 0.17f, 0.42f, z - 0.05f},
               {0.125f, 0.17f, 0.4f, z - 0.05f}},
              2.4f);
    m.shape.soft_box(seat, {-0.18f, 0.41f, -hz + 0.17f}, {0.18f, 0.84f, -hz + 0.19f}, 0.01f);
  } else {
    add_rings(m, seat,
              {{0.19f, 0.245f, 0.4f, z - 0.065f},
               {0.19f, 0.245f, 0.43f, z - 0.065f},
               {0.17f, 0.22f, 0.442f, z - 0.065f},
               {0.f, 0.f, 0.446f, z - 0.065f}},
              2.4f);
  }
}

void make_bathtub(FurnitureBuilder& m) {
  const MaterialId white = m.white();
  m.describe({0.94f, 0.94f, 0.93f}, "enamel");
  const float hx = 0.5f * m.w(), hz = 0.5f * m.d(), h = m.h();
  // Apron of tiles or enamel, rim, and the hollow inside.
  const MaterialId apron =
      m.rng.chance(0.5)
          ? white
          : m.materials.covering(Pattern::kTiles, {m.look.accent, {0.9f, 0.9f, 0.88f}}, {0.6f, 0.6f}, "tiles", 3);
  m.shape.quad(apron, {-hx, 0, hz}, {2 * hx, 0, 0}, {0, h, 0});
  m.shape.quad(apron, {hx, 0, hz}, {0, 0, -2 * hz}, {0, h, 0});
  m.shape.quad(apron, {-hx, 0, -hz}, {0, 0, 2 * hz}, {0, h, 0});
  m.shape.quad(apron, {hx, 0, -hz}, {-2 * hx, 0, 0}, {0, h, 0});
  add_rings(m, white,
            {{hx, hz, h, 0},
             {hx - 0.07f, hz - 0.07f, h + 0.01f, 0},
             {hx - 0.1f, hz - 0.1f, h - 0.04f, 0},
             {hx - 0.16f, hz - 0.13f, 0.22f, 0},
             {hx - 0.26f, hz - 0.2f, 0.15f, 0},
             {0.f, 0.f, 0.14f, 0}},
            7.f, 40);
  const Eigen::Affine3f before = m.shape.frame();
  m.shape.set_frame(before * Eigen::Translation3f(-hx + 0.06f, h, 0) * Eigen::AngleAxisf(kTurn / 4, Vec3::UnitY()));
  add_tap(m, {0, 0, 0}, 0.12f, 0.15f);
  m.shape.set_frame(before);
  m.shape.cylinder(m.chrome(), {-0.5f * hx, 0.152f, 0}, {-0.5f * hx, 0.158f, 0}, 0.03f, 0.03f, 12);
}

void make_shower(FurnitureBuilder& m) {
  const MaterialId white = m.white(), metal = m.chrome();
  m.describe({0.94f, 0.94f, 0.93f}, "ceramic");
  const float hx = 0.5f * m.w(), hz = 0.5f * m.d(), h = m.h();
  m.shape.soft_box(white, {-hx, 0, -hz}, {hx, 0.07f, hz}, 0.02f);
  m.shape.cylinder(metal, {0, 0.07f, 0}, {0, 0.074f, 0}, 0.045f, 0.045f, 14);
  m.shape.tube(metal,
               {{0, 0.95f, -hz + 0.02f},
                {0, 0.95f, -hz + 0.05f},
                {0, 2.02f, -hz + 0.05f},
                {0, 2.07f, -hz + 0.1f},
                {0, 2.07f, -hz + 0.32f},
                {0, 2.04f, -hz + 0.36f}},
               0.011f, 8);
  m.shape.lathe(metal, {0, 2.0f, -hz + 0.36f}, {{0, 0}, {0.1f, 0.f}, {0.1f, 0.012f}, {0.02f, 0.03f}, {0, 0.05f}}, 20);
  m.shape.soft_box(metal, {-0.12f, 1.04f, -hz}, {0.12f, 1.09f, -hz + 0.06f}, 0.02f);
  // Curtain on a rail across the open side, drawn halfway.
  m.shape.tube(metal, {{-hx, h, hz - 0.03f}, {hx, h, hz - 0.03f}}, 0.011f, 8);
  for (const float x : {-hx + 0.012f, hx - 0.012f}) m.shape.tube(metal, {{x, h, hz - 0.03f}, {x, h, -hz}}, 0.009f, 6);
  const bool open = m.draw_open(0.6);
  m.shape.drape(m.fabric(m.look.fabrics[1]), {-hx + 0.02f, 0.12f, hz - 0.08f},
                {open ? -hx + 0.4f * m.w() : hx - 0.02f, h - 0.015f, hz + 0.02f}, open ? 4 : 6);
}

void make_washbasin(FurnitureBuilder& m) {
  const MaterialId white = m.white();
  const float hx = 0.5f * m.w(), hz = 0.5f * m.d(), h = m.h();
  const bool vanity = m.rng.chance(0.65);
  m.describe({0.94f, 0.94f, 0.93f}, "ceramic");
  if (vanity) {
    const Rgb color = m.case_color();
    const MaterialId wood = m.case_material(color);
    m.shape.box(wood, {-hx + 0.01f, 0.26f, -hz}, {hx - 0.01f, h - 0.11f, hz - 0.03f});
    add_fronts(m, wood, m.chrome(), {-hx + 0.01f, 0.26f, hz - 0.03f}, {hx - 0.01f, h - 0.115f, hz - 0.01f},
               m.w() > 0.7f ? 2 : 1, m.rng.chance(0.5) ? 2 : 1, true);
  } else {
    m.shape.lathe(white, {0, 0, -0.03f},
                  {{0, 0}, {0.12f, 0}, {0.11f, 0.06f}, {0.08f, 0.2f}, {0.085f, 0.6f}, {0.13f, h - 0.1f}}, 20);
  }
  add_rings(m, white,
            {{hx - 0.08f, hz - 0.08f, h - 0.14f, 0},
             {hx - 0.01f, hz - 0.01f, h - 0.06f, 0},
             {hx, hz, h - 0.01f, 0},
             {hx - 0.01f, hz - 0.01f, h, 0},
             {hx - 0.04f, hz - 0.07f, h, 0.02f},
             {hx - 0.07f, hz - 0.1f, h - 0.05f, 0.02f},
             {0.5f * hx, 0.5f * hz, h - 0.1f, 0.02f},
             {0, 0, h - 0.105f, 0.02f}},
            4.f, 28);
  add_tap(m, {0, h - 0.002f, -hz + 0.05f}, 0.13f, 0.14f);
  if (vanity && m.w() > 0.65f) m.supports.push_back({{hx - 0.1f, h, -hz + 0.07f}, {0.04f, 0.02f}, 0.3f});
}

void make_washing_machine(FurnitureBuilder& m) {
  const Rgb color = m.rng.chance(0.75) ? Rgb(0.94f, 0.94f, 0.94f) : Rgb(0.35f, 0.36f, 0.38f);
  m.describe(color, "metal");
  const MaterialId body = m.plain("metal", color);
  const float hx = 0.5f * m.w(), hz = 0.5f * m.d(), h = m.h();
  m.shape.soft_box(body, {-hx, 0.03f, -hz}, {hx, h, hz - 0.02f}, 0.02f);
  const Eigen::Affine3f before = m.shape.frame();
  const bool open = m.state == "open";
  const Eigen::Affine3f port =
      before * Eigen::Translation3f(0, 0.42f, hz - 0.022f) * Eigen::AngleAxisf(kTurn / 4, Vec3::UnitX());
  if (open) {  // the dark drum in its ring, and the door beside it
    m.shape.set_frame(port);
    m.shape.lathe(m.plain("metal", {0.55f, 0.56f, 0.58f}), Vec3::Zero(),
                  {{0.21f, 0}, {0.21f, 0.012f}, {0.175f, 0.012f}}, 28);
    m.shape.lathe(m.plain("metal", {0.07f, 0.07f, 0.08f}), Vec3::Zero(), {{0.178f, 0.006f}, {0, 0.005f}}, 24);
    m.shape.set_frame(open_leaf(m, {-0.24f, hz + 0.02f}, {-0.22f, 0.2f, hz - 0.022f}, {0.22f, 0.64f, hz + 0.02f}) *
                      port);
  } else {
    m.shape.set_frame(port);
  }
  m.shape.lathe(m.chrome(), Vec3::Zero(), {{0.22f, 0}, {0.22f, 0.02f}, {0.2f, 0.035f}, {0.165f, 0.03f}}, 28);
  m.shape.lathe(m.plain("glass", {0.16f, 0.18f, 0.22f}), Vec3::Zero(),
                {{0.17f, 0.028f}, {0.13f, 0.018f}, {0.06f, 0.008f}, {0, 0.005f}}, 24);
  m.shape.set_frame(before);
  m.shape.box(m.plain("plastic", {0.8f, 0.81f, 0.83f}), {-hx + 0.02f, h - 0.14f, hz - 0.022f},
              {hx - 0.02f, h - 0.03f, hz - 0.014f});
  m.shape.cylinder(m.chrome(), {0.05f, h - 0.085f, hz - 0.016f}, {0.05f, h - 0.085f, hz + 0.006f}, 0.035f, 0.03f, 14);
  m.shape.box(m.black(), {0.12f, h - 0.11f, hz - 0.016f}, {hx - 0.06f, h - 0.06f, hz - 0.011f});
  m.attributes["state"] = open ? "open" : "off";
  m.supports.push_back({{0, h, -0.02f}, {hx - 0.1f, hz - 0.12f}, 0.6f});
}

void make_towel_rail(FurnitureBuilder& m) {
  const float hx = 0.5f * m.w(), z = -0.5f * m.d();
  for (const float y : {0.f, 0.28f}) {
    m.shape.tube(m.chrome(), {{-hx, y, z}, {-hx, y, z + 0.07f}, {hx, y, z + 0.07f}, {hx, y, z}}, 0.009f, 8);
  }
  const Rgb color = m.fabric_color();
  m.shape.soft_box(m.materials.tinted(Pattern::kCarpet, color), {-0.7f * hx, -0.42f, z + 0.05f},
                   {0.25f * hx, 0.012f, z + 0.09f}, 0.015f);
  m.shape.soft_box(m.materials.tinted(Pattern::kCarpet, m.look.fabrics[2]), {-0.05f * hx, -0.05f, z + 0.05f},
                   {0.8f * hx, 0.292f, z + 0.09f}, 0.015f);
}

void make_laundry_basket(FurnitureBuilder& m) {
  m.describe(m.look.wood, "wicker");
  const float r = 0.5f * m.w(), h = m.h();
  m.shape.lathe(m.materials.tinted(Pattern::kWicker, m.look.wood), Vec3::Zero(),
                {{0, 0},
                 {0.85f * r, 0},
                 {0.85f * r, 0},
                 {r, 0.9f * h},
                 {1.03f * r, 0.92f * h},
                 {1.03f * r, 0.96f * h},
                 {0.5f * r, h},
                 {0, h}},
                20);
}

}  // namespace wiw::apartment
