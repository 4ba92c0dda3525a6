// SPDX-License-Identifier: Apache-2.0
// Frames, door leaves and windows.
#include <array>
#include <cmath>

#include "wiw/apartment/draft.hpp"
#include "wiw/apartment/random.hpp"
#include "wiw/core/intrinsics.hpp"

namespace wiw::apartment {

namespace {

constexpr float kLining = 0.03f;  // thickness of the boards that line a doorway
constexpr float kInnerFace = kInnerWall / 2;

Vec3 inward(Side side) {
  switch (side) {
    case Side::kWest: return Vec3::UnitX();
    case Side::kEast: return -Vec3::UnitX();
    case Side::kNorth: return Vec3::UnitZ();
    case Side::kSouth: return -Vec3::UnitZ();
  }
  return Vec3::Zero();
}

/// Frame of an opening: x along the wall, z into room_a, origin on the floor in the middle of the wall and opening.
Eigen::Affine3f frame_of(const Opening& opening) {
  const Vec3 z = inward(opening.side), x = Vec3::UnitY().cross(z);
  const float middle = 0.5f * (opening.low + opening.high);
  Eigen::Affine3f frame = Eigen::Affine3f::Identity();
  frame.linear() << x, Vec3::UnitY(), z;
  frame.translation() = runs_along_x(opening.side) ? Vec3(middle, 0, opening.line) : Vec3(opening.line, 0, middle);
  return frame;
}

/// Three boards around a doorway through a wall from z0 to z1, mouldings on both faces, a flat sill.
void add_lining(FurnitureShape& shape, MaterialId material, MaterialId sill, const Opening& o, float z0, float z1,
                bool moulding) {
  const float half = 0.5f * o.width();
  shape.box(material, {-half, 0, z0}, {-half + kLining, o.top, z1});
  shape.box(material, {half - kLining, 0, z0}, {half, o.top, z1});
  shape.box(material, {-half + kLining, o.top - kLining, z0}, {half - kLining, o.top, z1});
  shape.box(sill, {-half, -0.02f, z0}, {half, 0.004f, z1});
  if (!moulding) return;
  constexpr float kWide = 0.07f, kProud = 0.016f;
  for (const auto& [a, b] : {std::pair{z1, z1 + kProud}, std::pair{z0 - kProud, z0}}) {
    shape.box(material, {-half - kWide + kLining, 0, a}, {-half + kLining - 0.008f, o.top + kWide - kLining, b});
    shape.box(material, {half - kLining + 0.008f, 0, a}, {half + kWide - kLining, o.top + kWide - kLining, b});
    shape.box(material, {-half + kLining - 0.008f, o.top - kLining + 0.008f, a},
              {half - kLining + 0.008f, o.top + kWide - kLining, b});
  }
}

void add_handle(FurnitureShape& shape, MaterialId metal, float x, float z, float direction) {
  for (const float face : {z, z - 0.04f}) {
    const float out = face == z ? 1.f : -1.f;
    shape.cylinder(metal, {x, 1.02f, face}, {x, 1.02f, face + out * 0.012f}, 0.026f, 0.026f, 10);
    shape.tube(metal,
               {{x, 1.02f, face},
                {x, 1.02f, face + out * 0.05f},
                {x - direction * 0.03f, 1.02f, face + out * 0.055f},
                {x - direction * 0.12f, 1.02f, face + out * 0.055f}},
               0.009f, 6);
  }
}

/// Leaf hanging at x = 0, closed along +x (times `direction`), its room_a face at z = 0.
void add_leaf(FurnitureShape& shape, MaterialId material, MaterialId panel, MaterialId metal, float width, float height,
              float direction, int style) {
  const auto span = [&](float a, float b) {
    return std::pair{std::min(direction * a, direction * b), std::max(direction * a, direction * b)};
  };
  const auto [x0, x1] = span(0.f, width);
  constexpr float kThick = 0.04f;
  shape.box(material, {x0, 0.01f, -kThick}, {x1, height, 0.f});
  const int rows = style == 0 ? 0 : style == 1 ? 2 : style == 2 ? 3 : 4;
  for (int r = 0; r < rows; ++r) {  // raised fields
    const float y0 = 0.14f + (height - 0.2f) * static_cast<float>(r) / static_cast<float>(rows);
    const float y1 = 0.06f + (height - 0.2f) * static_cast<float>(r + 1) / static_cast<float>(rows) + 0.04f;
    const auto [a, b] = span(0.13f, width - 0.13f);
    shape.soft_box(panel, {a, y0, -kThick - 0.008f}, {b, y1, 0.008f}, 0.008f, 0.f, 1);
  }
  add_handle(shape, metal, direction * (width - 0.06f), 0.f, direction);
}

void describe(Object& object, const Rgb& color, const std::string& material, const std::string& state) {
  object.color = color;
  object.attributes["color"] = color_name(color);
  object.attributes["material"] = material;
  object.attributes["state"] = state;
}

/// Oak, painted and steel styles repeat through one apartment.
struct DoorStyle {
  MaterialId frame, leaf, panel, metal;
  int style;
};

DoorStyle door_style(Draft& draft, std::int32_t room) {
  Rng rng = stream(draft.seed, Stream::kOpenings, 77);
  const Rgb trim = draft.palette.rooms[static_cast<std::size_t>(room)].trim;
  const MaterialId leaf = draft.materials.tinted(Pattern::kGrain, draft.palette.door);
  const MaterialId metal =
      draft.materials.plain("metal", rng.chance(0.5) ? Rgb(0.75f, 0.75f, 0.76f) : Rgb(0.72f, 0.6f, 0.35f));
  return {draft.materials.plain("wood", trim), leaf, leaf, metal, static_cast<int>(rng.below(4))};
}

void add_door(Draft& draft, const Opening& o) {
  const bool entrance = o.kind == OpeningKind::kEntrance;
  const DoorStyle style = door_style(draft, o.room_a);
  const Eigen::Affine3f frame = frame_of(o);
  const std::string room = draft.plan.rooms[static_cast<std::size_t>(o.room_a)].name;
  const MaterialId sill = draft.materials.tinted(Pattern::kGrain, draft.palette.door);
  Object lining{"door frame of " + room, "door frame", {}, o.room_a, frame};
  add_lining(lining.shape, style.frame, sill, o, entrance ? kInnerFace - kOuterWall : -kInnerFace, kInnerFace, true);
  describe(lining, draft.materials.finish(style.frame).color, "wood", "fixed");
  draft.objects.push_back(std::move(lining));

  Object leaf{entrance ? "entrance door" : "door of " + room, "door", {}, o.room_a, frame};
  const float axis = (o.side == Side::kWest || o.side == Side::kSouth) ? -1.f : 1.f;  // sense of the frame's x
  const float hinge = (o.hinge_low ? -1.f : 1.f) * axis;  // end of the opening in the frame's x
  const float width = o.width() - 2 * kLining - 0.006f;
  leaf.pose = frame * Eigen::Translation3f(hinge * (0.5f * o.width() - kLining - 0.003f), 0, kInnerFace + 0.002f) *
              Eigen::AngleAxisf(hinge * o.angle, Vec3::UnitY());
  const MaterialId face =
      entrance ? draft.materials.tinted(Pattern::kGrain, draft.palette.rooms[static_cast<std::size_t>(o.room_a)].accent)
               : style.leaf;
  add_leaf(leaf.shape, face, face, style.metal, width, o.top - kLining - 0.005f, -hinge, style.style);
  describe(leaf, draft.materials.finish(face).color, "wood", entrance ? "closed" : "open");
  draft.objects.push_back(std::move(leaf));
}

void add_arch(Draft& draft, const Opening& o) {
  const bool plain = is_passage(draft.plan.rooms[static_cast<std::size_t>(o.room_a)].type);
  const RoomLook& look = draft.palette.rooms[static_cast<std::size_t>(o.room_a)];
  const MaterialId side =
      plain ? draft.materials.tinted(Pattern::kPlaster, look.wall) : draft.materials.plain("wood", look.trim);
  Object arch{
      "passage of " + draft.plan.rooms[static_cast<std::size_t>(o.room_a)].name, "passage", {}, o.room_a, frame_of(o)};
  add_lining(arch.shape, side, draft.materials.tinted(Pattern::kGrain, draft.palette.door), o, -kInnerFace, kInnerFace,
             !plain);
  describe(arch, draft.materials.finish(side).color, draft.materials.finish(side).kind, "open");
  draft.objects.push_back(std::move(arch));
}

/// Reveals of the wall around a window and its sill boards.
void add_reveal(FurnitureShape& shape, MaterialId wall, MaterialId board, const Opening& o) {
  const float half = 0.5f * o.width(), out = kInnerFace - kOuterWall, height = o.top - o.bottom;
  const Vec3 depth(0, 0, kOuterWall);
  shape.quad(wall, {-half, o.bottom, out}, {0, height, 0}, depth);
  shape.quad(wall, {half, o.bottom, out}, depth, {0, height, 0});
  shape.quad(wall, {-half, o.top, out}, {o.width(), 0, 0}, depth);
  shape.soft_box(board, {-half - 0.04f, o.bottom - 0.03f, out}, {half + 0.04f, o.bottom, kInnerFace + 0.05f}, 0.01f,
                 0.f, 1);
}

void add_sashes(FurnitureShape& shape, MaterialId frame, MaterialId metal, const Opening& o, int panes, bool crossbar) {
  const float half = 0.5f * o.width(), z0 = -0.12f, z1 = -0.06f;
  constexpr float kBar = 0.055f;
  const auto bar = [&](float xa, float ya, float xb, float yb, float proud) {
    shape.soft_box(frame, {xa, ya, z0}, {xb, yb, z1 + proud}, 0.008f, 0.f, 1);
  };
  bar(-half, o.bottom, -half + kBar, o.top, 0.f);
  bar(half - kBar, o.bottom, half, o.top, 0.f);
  bar(-half + kBar, o.bottom, half - kBar, o.bottom + kBar, 0.f);
  bar(-half + kBar, o.top - kBar, half - kBar, o.top, 0.f);
  for (int i = 1; i < panes; ++i) {
    const float x = -half + o.width() * static_cast<float>(i) / static_cast<float>(panes);
    bar(x - 0.045f, o.bottom + kBar, x + 0.045f, o.top - kBar, 0.01f);
    shape.soft_box(metal, {x - 0.012f, 0.5f * (o.bottom + o.top) - 0.06f, z1 + 0.01f},
                   {x + 0.012f, 0.5f * (o.bottom + o.top) + 0.06f, z1 + 0.035f}, 0.008f, 0.f, 1);
  }
  const float y = o.bottom + 0.68f * (o.top - o.bottom);
  if (crossbar) bar(-half + kBar, y - 0.02f, half - kBar, y + 0.02f, -0.01f);
}

void add_window(Draft& draft, const Opening& o) {
  Rng rng = stream(draft.seed, Stream::kOpenings, 78);
  const RoomLook& look = draft.palette.rooms[static_cast<std::size_t>(o.room_a)];
  const bool wooden = rng.chance(0.35);
  const MaterialId frame = wooden ? draft.materials.tinted(Pattern::kGrain, draft.palette.door)
                                  : draft.materials.plain("plastic", look.trim);
  Object window{
      "window of " + draft.plan.rooms[static_cast<std::size_t>(o.room_a)].name, "window", {}, o.room_a, frame_of(o)};
  add_reveal(window.shape, draft.materials.tinted(Pattern::kPlaster, look.wall), frame, o);
  add_sashes(window.shape, frame, draft.materials.plain("metal", {0.75f, 0.75f, 0.76f}), o,
             o.width() > 1.9f    ? 3
             : o.width() > 0.95f ? 2
                                 : 1,
             rng.chance(0.5));
  describe(window, draft.materials.finish(frame).color, wooden ? "wood" : "plastic", "closed");
  const Eigen::Affine3f pose = window.pose;
  const float half_height = 0.5f * (o.top - o.bottom);
  draft.lights.push_back({pose * Vec3(0, o.bottom + half_height, kInnerFace - 0.03f),
                          pose.linear() * Vec3(0.46f * o.width(), 0, 0), Vec3(0, 0.94f * half_height, 0),
                          pose.linear() * Vec3::UnitZ(), Rgb::Constant(4.f * 0.25f * o.width() * 2.f * half_height),
                          o.room_a, draft.objects.size()});
  draft.objects.push_back(std::move(window));
}

}  // namespace

void build_openings(Draft& draft) {
  for (const Opening& opening : draft.plan.openings) {
    switch (opening.kind) {
      case OpeningKind::kDoor:
      case OpeningKind::kEntrance: add_door(draft, opening); break;
      case OpeningKind::kArch: add_arch(draft, opening); break;
      case OpeningKind::kWindow: add_window(draft, opening); break;
    }
  }
}

}  // namespace wiw::apartment
