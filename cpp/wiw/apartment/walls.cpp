// SPDX-License-Identifier: Apache-2.0
// Floors, ceilings, walls and skirting boards.
#include <set>

#include "wiw/apartment/draft.hpp"
#include "wiw/apartment/random.hpp"

namespace wiw::apartment {

namespace {

constexpr float kFloorTexel = 0.04f, kWallTexel = 0.06f, kCeilingTexel = 0.1f;
constexpr float kSkirting = 0.08f;

/// One side of a room: a frame whose u runs along the wall, v upwards, u x v into the room.
Chart wall_chart(const Rect& inside, Side side, float height) {
  const Vec3 up = Vec3::UnitY();
  const float x = inside.width(), z = inside.depth();
  switch (side) {
    case Side::kWest: return {{inside.x0, 0, inside.z1}, -Vec3::UnitZ(), up, {z, height}, kWallTexel, {}};
    case Side::kEast: return {{inside.x1, 0, inside.z0}, Vec3::UnitZ(), up, {z, height}, kWallTexel, {}};
    case Side::kNorth: return {{inside.x0, 0, inside.z0}, Vec3::UnitX(), up, {x, height}, kWallTexel, {}};
    case Side::kSouth: return {{inside.x1, 0, inside.z1}, -Vec3::UnitX(), up, {x, height}, kWallTexel, {}};
  }
  return {};
}

Eigen::AlignedBox2f hole_in(const Chart& chart, const Opening& opening) {
  const float origin = chart.u.dot(chart.origin), sign = chart.u.sum();
  const float a = sign * opening.low - origin, b = sign * opening.high - origin;
  return {Vec2(std::min(a, b), opening.bottom), Vec2(std::max(a, b), opening.top)};
}

void add_holes(Chart& chart, const FloorPlan& plan, std::int32_t room, Side side) {
  for (const Opening& opening : plan.openings) {
    const bool here = opening.room_a == room || opening.room_b == room;
    if (here && side_in(opening, room) == side) chart.holes.push_back(hole_in(chart, opening));
  }
}

void add_rectangle(Submesh& part, const Chart& chart, const Vec2& low, const Vec2& high, const Vec2& uv_origin) {
  const auto base = static_cast<std::uint32_t>(part.positions.size());
  for (const Vec2& p : {low, Vec2(high.x(), low.y()), high, Vec2(low.x(), high.y())}) {
    part.positions.emplace_back(chart.origin + p.x() * chart.u + p.y() * chart.v);
    part.normals.push_back(chart.u.cross(chart.v));
    part.uv.emplace_back(p.x() - uv_origin.x(), uv_origin.y() - p.y());
    part.tint.emplace_back(Rgb::Ones());
  }
  part.triangles.emplace_back(base, base + 1, base + 2);
  part.triangles.emplace_back(base, base + 2, base + 3);
}

/// Covers the band [bottom, top] of a wall except its holes.
Submesh cover(const Chart& chart, MaterialId material, float bottom, float top) {
  std::set<float> xs{0.f, chart.size.x()}, ys{bottom, top};
  for (const auto& hole : chart.holes) {
    xs.insert({hole.min().x(), hole.max().x()});
    for (const float y : {hole.min().y(), hole.max().y()}) {
      if (y > bottom && y < top) ys.insert(y);
    }
  }
  Submesh part{material, {}, {}, {}, {}, {}};
  const Vec2 uv_origin(0.5f * chart.size.x(), chart.size.y());
  for (auto x = xs.begin(); std::next(x) != xs.end(); ++x) {
    for (auto y = ys.begin(); std::next(y) != ys.end(); ++y) {
      const Vec2 low(*x, *y), high(*std::next(x), *std::next(y)), middle = 0.5f * (low + high);
      const bool hollow =
          std::any_of(chart.holes.begin(), chart.holes.end(), [&](const auto& hole) { return hole.contains(middle); });
      if (!hollow && (high - low).minCoeff() > 1e-4f) add_rectangle(part, chart, low, high, uv_origin);
    }
  }
  return part;
}

struct Covering {
  MaterialId upper, lower;
  float split = 0.f;
};

std::uint32_t variant(const Draft& draft, std::int32_t room) {
  return stream(draft.seed, Stream::kTextures, 1000 + static_cast<std::uint64_t>(room))() >> 8;
}

MaterialId tile_material(Draft& draft, const RoomLook& look, std::int32_t room) {
  Rng rng = stream(draft.seed, Stream::kRooms, static_cast<std::uint64_t>(room), 7);
  const Rgb joint = to_encoded(to_linear(look.accent) * 0.55f + Rgb::Constant(0.3f));
  const bool metro = rng.chance(0.4);
  const float side = snap(range(rng, 0.6f, 1.2f));
  if (metro)
    return draft.materials.covering(Pattern::kBricks, {look.accent, joint}, {1.0f, 1.0f}, "tiles",
                                    variant(draft, room));
  return draft.materials.covering(Pattern::kTiles, {look.accent, joint}, {side, side}, "tiles", variant(draft, room));
}

MaterialId paper_material(Draft& draft, const RoomLook& look, std::int32_t room) {
  Rng rng = stream(draft.seed, Stream::kRooms, static_cast<std::uint64_t>(room), 8);
  const float side = range(rng, 0.7f, 1.1f);
  std::vector<Rgb> colors{look.wall, to_encoded(0.5f * (to_linear(look.wall) + to_linear(look.accent))), look.accent};
  return draft.materials.covering(look.paper, colors, {side, side}, "wallpaper", variant(draft, room));
}

Covering covering(Draft& draft, std::int32_t room, Side side) {
  const RoomLook& look = draft.palette.rooms[static_cast<std::size_t>(room)];
  const MaterialId paint = draft.materials.tinted(Pattern::kPlaster, look.wall);
  const bool accent = static_cast<int>(side) == look.accent_side;
  switch (look.walls) {
    case WallStyle::kPaint: return {paint, paint};
    case WallStyle::kAccentWall: {
      const MaterialId other = draft.materials.tinted(Pattern::kPlaster, look.accent);
      return accent ? Covering{other, other} : Covering{paint, paint};
    }
    case WallStyle::kAccentBrick: {
      const Rgb mortar = to_encoded(to_linear(look.accent) * 0.4f + Rgb::Constant(0.38f));
      const MaterialId brick = draft.materials.covering(Pattern::kBricks, {look.accent, mortar}, {0.96f, 0.9f}, "brick",
                                                        variant(draft, room));
      return accent ? Covering{brick, brick} : Covering{paint, paint};
    }
    case WallStyle::kWallpaper:
    case WallStyle::kAccentWallpaper: {
      const MaterialId paper = paper_material(draft, look, room);
      return look.walls == WallStyle::kWallpaper || accent ? Covering{paper, paper} : Covering{paint, paint};
    }
    case WallStyle::kWainscot: {
      const Rgb color = look.trim;
      return {paint,
              draft.materials.covering(Pattern::kBoards, {color}, {0.9f, 0.9f}, "wood panelling", variant(draft, room)),
              look.split_height};
    }
    case WallStyle::kHalfTiles: return {paint, tile_material(draft, look, room), look.split_height};
    case WallStyle::kFullTiles: {
      const MaterialId tiles = tile_material(draft, look, room);
      return {tiles, tiles};
    }
  }
  return {paint, paint};
}

std::size_t add_chart(Draft& draft, Chart chart) {
  draft.charts.push_back(std::move(chart));
  return draft.charts.size() - 1;
}

/// Board along a wall, left out at the holes it would cross.
void add_skirting(Object& object, const Chart& chart, MaterialId material, float bottom, float height, float proud) {
  const Vec3 inward = chart.u.cross(chart.v);
  std::set<float> xs{0.f, chart.size.x()};
  for (const auto& hole : chart.holes) {
    if (hole.min().y() < bottom + height && hole.max().y() > bottom)
      xs.insert({hole.min().x() - 0.07f, hole.max().x() + 0.07f});
  }
  for (auto x = xs.begin(); std::next(x) != xs.end(); ++x) {
    const float a = std::max(0.f, *x), b = std::min(chart.size.x(), *std::next(x));
    const bool hollow = std::any_of(chart.holes.begin(), chart.holes.end(), [&](const auto& hole) {
      return hole.contains(Vec2(0.5f * (a + b), bottom + 0.5f * height));
    });
    if (hollow || b - a < 0.01f) continue;
    const Vec3 foot = chart.origin + a * chart.u + bottom * chart.v + proud * inward;
    object.shape.quad(material, foot, (b - a) * chart.u, height * chart.v);
    object.shape.quad(material, foot + height * chart.v, (b - a) * chart.u, -proud * inward);
  }
}

void add_walls(Draft& draft, std::int32_t room) {
  const PlanRoom& plan = draft.plan.rooms[static_cast<std::size_t>(room)];
  const RoomLook& look = draft.palette.rooms[static_cast<std::size_t>(room)];
  Object walls{"walls of " + plan.name, "wall", {}, room};
  walls.color = look.walls == WallStyle::kFullTiles ? look.accent : look.wall;
  walls.attributes["color"] = color_name(walls.color);
  walls.shape.set_edge(0.3f);
  const MaterialId board = draft.materials.plain("wood", look.trim);
  for (const Side side : {Side::kWest, Side::kEast, Side::kNorth, Side::kSouth}) {
    Chart chart = wall_chart(plan.inside(), side, draft.plan.ceiling);
    add_holes(chart, draft.plan, room, side);
    const Covering cover_of = covering(draft, room, side);
    walls.attributes.emplace("material", draft.materials.finish(cover_of.upper).kind);
    if (!is_wet(plan.type)) add_skirting(walls, chart, board, 0.f, kSkirting, 0.014f);
    if (cover_of.split > 0.f) add_skirting(walls, chart, board, cover_of.split - 0.02f, 0.04f, 0.018f);
    const std::size_t index = add_chart(draft, chart);
    if (cover_of.split > 0.f) walls.panels.push_back({cover(chart, cover_of.lower, 0.f, cover_of.split), index});
    walls.panels.push_back({cover(chart, cover_of.upper, cover_of.split, draft.plan.ceiling), index});
  }
  draft.objects.push_back(std::move(walls));
}

MaterialId floor_material(Draft& draft, std::int32_t room) {
  const RoomLook& look = draft.palette.rooms[static_cast<std::size_t>(room)];
  Rng rng = stream(draft.seed, Stream::kRooms, static_cast<std::uint64_t>(room), 9);
  const float tile = pick(rng, std::array<float, 3>{0.3f, 0.4f, 0.5f});
  const Rgb joint = to_encoded(to_linear(look.floor_color) * 0.5f + Rgb::Constant(0.12f));
  const Rgb veins = to_encoded(to_linear(look.floor_color) * 0.45f);
  switch (look.floor) {
    case Pattern::kTiles:
      return draft.materials.covering(look.floor, {look.floor_color, joint}, Vec2::Constant(4.f * tile), "tiles",
                                      variant(draft, room));
    case Pattern::kChecker:
      return draft.materials.covering(look.floor, {look.floor_color, look.floor_second}, Vec2::Constant(4.f * tile),
                                      "tiles", variant(draft, room));
    case Pattern::kHexagons:
      return draft.materials.covering(look.floor, {look.floor_color, joint, look.floor_second}, {1.5f, 1.3f}, "tiles",
                                      variant(draft, room));
    case Pattern::kMarble:
      return draft.materials.covering(look.floor, {look.floor_color, veins}, {2.4f, 2.4f}, "marble",
                                      variant(draft, room));
    case Pattern::kTerrazzo:
      return draft.materials.covering(look.floor, {look.floor_color, look.floor_second, veins, look.accent, look.wood},
                                      {0.8f, 0.8f}, "terrazzo", variant(draft, room));
    default: return draft.materials.tinted(look.floor, look.floor_color);
  }
}

void add_floor_and_ceiling(Draft& draft, std::int32_t room) {
  const PlanRoom& plan = draft.plan.rooms[static_cast<std::size_t>(room)];
  const RoomLook& look = draft.palette.rooms[static_cast<std::size_t>(room)];
  const Rect r = plan.inside();
  const MaterialId ground = floor_material(draft, room);
  Object floor{"floor of " + plan.name,
               "floor",
               {{"color", color_name(look.floor_color)}, {"material", draft.materials.finish(ground).kind}},
               room};
  floor.color = look.floor_color;
  const bool along_x = r.width() >= r.depth();  // boards run the long way
  Chart chart = along_x
                    ? Chart{{r.x0, 0, r.z1}, Vec3::UnitX(), -Vec3::UnitZ(), {r.width(), r.depth()}, kFloorTexel, {}}
                    : Chart{{r.x1, 0, r.z1}, -Vec3::UnitZ(), -Vec3::UnitX(), {r.depth(), r.width()}, kFloorTexel, {}};
  std::size_t index = add_chart(draft, chart);
  floor.panels.push_back({cover(chart, ground, 0.f, chart.size.y()), index});
  draft.objects.push_back(std::move(floor));

  Object ceiling{
      "ceiling of " + plan.name, "ceiling", {{"color", color_name(look.ceiling)}, {"material", "plaster"}}, room};
  ceiling.color = look.ceiling;
  chart = {{r.x0, draft.plan.ceiling, r.z0}, Vec3::UnitX(), Vec3::UnitZ(), {r.width(), r.depth()}, kCeilingTexel, {}};
  index = add_chart(draft, chart);
  ceiling.panels.push_back(
      {cover(chart, draft.materials.tinted(Pattern::kPlaster, look.ceiling), 0.f, chart.size.y()), index});
  draft.objects.push_back(std::move(ceiling));
}

}  // namespace

void build_walls(Draft& draft) {
  for (std::int32_t room = 0; room < static_cast<std::int32_t>(draft.plan.rooms.size()); ++room) {
    add_floor_and_ceiling(draft, room);
    add_walls(draft, room);
  }
}

}  // namespace wiw::apartment
