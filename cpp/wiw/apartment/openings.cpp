// SPDX-License-Identifier: Apache-2.0
// Doors, arches, the entrance and windows of a floor plan.
#include <array>
#include <cmath>
#include <optional>

#include "wiw/apartment/floor_plan.hpp"
#include "wiw/apartment/random.hpp"
#include "wiw/apartment/room_floor.hpp"
#include "wiw/core/intrinsics.hpp"

namespace wiw::apartment {

Rect threshold(const FloorPlan& plan, const Opening& opening, std::int32_t room, float reach) {
  const Rect inside = plan.rooms[static_cast<std::size_t>(room)].inside();
  switch (side_in(opening, room)) {
    case Side::kWest: return {inside.x0, opening.low, inside.x0 + reach, opening.high};
    case Side::kEast: return {inside.x1 - reach, opening.low, inside.x1, opening.high};
    case Side::kNorth: return {opening.low, inside.z0, opening.high, inside.z0 + reach};
    case Side::kSouth: return {opening.low, inside.z1 - reach, opening.high, inside.z1};
  }
  return {};
}

Rect swing(const FloorPlan& plan, const Opening& opening) {
  if (opening.kind != OpeningKind::kDoor) return kNowhere;
  Opening wide = opening;  // past a right angle the leaf sweeps beyond its hinge
  const float beyond = std::max(0.f, -std::cos(opening.angle)) * opening.width() + 0.06f;
  (opening.hinge_low ? wide.low : wide.high) += opening.hinge_low ? -beyond : beyond;
  return threshold(plan, wide, opening.room_a, opening.width() + 0.05f);
}

namespace {

using Index = std::int32_t;

const PlanRoom& room_of(const FloorPlan& plan, Index i) { return plan.rooms[static_cast<std::size_t>(i)]; }

bool is_taken(const FloorPlan& plan, float line, bool along_x, float low, float high) {
  return std::any_of(plan.openings.begin(), plan.openings.end(), [&](const Opening& o) {
    return runs_along_x(o.side) == along_x && std::abs(o.line - line) < kInnerWall && low < o.high + 0.3f &&
           o.low - 0.3f < high;
  });
}

/// Whether the new leaf stays clear of the other doors of its room, and they of it.
bool leaf_fits(const FloorPlan& plan, const Opening& door) {
  const Rect sweep = swing(plan, door);
  if (!room_of(plan, door.room_a).inside().grown(0.01f).contains(sweep)) return false;
  return std::none_of(plan.openings.begin(), plan.openings.end(), [&](const Opening& o) {
    if (!o.passable() && o.kind != OpeningKind::kEntrance) return false;
    const bool here = o.room_a == door.room_a || o.room_b == door.room_a;
    return (here && sweep.overlaps(threshold(plan, o, door.room_a, 0.45f))) ||
           (o.room_a == door.room_a && sweep.overlaps(swing(plan, o))) ||
           (o.room_a == door.room_b && swing(plan, o).overlaps(threshold(plan, door, door.room_b, 0.45f))) ||
           (o.room_a == door.room_a && swing(plan, o).overlaps(threshold(plan, door, door.room_a, 0.45f)));
  });
}

void hang_leaf(const FloorPlan& plan, Opening& door, Rng& rng) {
  const Rect inside = room_of(plan, door.room_a).inside();
  const float begin = runs_along_x(door.side) ? inside.x0 : inside.z0;
  const float end = runs_along_x(door.side) ? inside.x1 : inside.z1;
  door.hinge_low = door.low - begin < end - door.high;
  const float gap = door.hinge_low ? door.low - begin : end - door.high;
  door.angle = static_cast<float>(radians(gap < 0.35f ? rng.uniform(76, 89) : rng.uniform(76, 104)));
}

struct Pair {
  Index a, b;
};

/// Where along a wall an opening of this width may begin.
std::optional<float> try_position(const SharedWall& wall, float width, Rng& rng) {
  constexpr float kCorner = kInnerWall / 2 + 0.14f;
  const float room = wall.length() - 2 * kCorner - width;
  if (room < 0.f) return std::nullopt;
  const float offset = rng.chance(0.45) ? (rng.chance(0.5) ? 0.f : room) : range(rng, 0.f, room);
  return snap(wall.low + kCorner + offset);
}

std::optional<Opening> try_door(const FloorPlan& plan, Pair pair, OpeningKind kind, Rng& rng) {
  const SharedWall wall = shared_wall(room_of(plan, pair.a).cell, room_of(plan, pair.b).cell);
  float width = 0.05f * static_cast<float>(18 + rng.below(3));
  if (kind == OpeningKind::kArch) width = std::min(snap(range(rng, 1.0f, 2.2f)), wall.length() - 0.45f);
  const std::optional<float> low = try_position(wall, width, rng);
  if (!low || is_taken(plan, wall.line, runs_along_x(wall.side), *low, *low + width)) return std::nullopt;
  Opening door{kind, pair.a, pair.b, wall.side, wall.line, *low, *low + width};
  if (kind == OpeningKind::kDoor) {
    hang_leaf(plan, door, rng);
    if (!leaf_fits(plan, door)) return std::nullopt;
  } else {
    door.top = snap(range(rng, 2.1f, 2.3f));
  }
  return door;
}

/// Joins two rooms; the leaf swings into the first. Without room for a leaf the passage stays open.
bool join(FloorPlan& plan, Pair pair, OpeningKind kind, Rng& rng) {
  for (int attempt = 0; attempt < 48; ++attempt) {
    if (attempt == 32) kind = OpeningKind::kArch;
    if (auto door = try_door(plan, pair, kind, rng)) {
      plan.openings.push_back(*door);
      return true;
    }
  }
  return false;
}

bool touch(const FloorPlan& plan, Index a, Index b) {
  return shared_wall(room_of(plan, a).cell, room_of(plan, b).cell).length() >= kDoorWall;
}

bool joined(const FloorPlan& plan, Index a, Index b) {
  return std::any_of(plan.openings.begin(), plan.openings.end(), [&](const Opening& o) {
    return (o.room_a == a && o.room_b == b) || (o.room_a == b && o.room_b == a);
  });
}

/// Corridors that meet are one space: the wall between them is open over its whole width.
void join_passages(FloorPlan& plan) {
  const Index count = static_cast<Index>(plan.rooms.size());
  for (Index a = 0; a < count; ++a) {
    for (Index b = a + 1; b < count; ++b) {
      if (!is_passage(room_of(plan, a).type) || !is_passage(room_of(plan, b).type)) continue;
      const SharedWall wall = shared_wall(room_of(plan, a).cell, room_of(plan, b).cell);
      if (wall.length() < 1.f) continue;
      constexpr float kReturn = kInnerWall / 2 + 0.02f;
      plan.openings.push_back({OpeningKind::kArch, a, b, wall.side, wall.line, wall.low + kReturn, wall.high - kReturn,
                               0.f, plan.ceiling - 0.25f});
    }
  }
}

/// How much two rooms want a door between them; 0 is not at all.
double affinity(RoomType a, RoomType b) {
  using enum RoomType;
  const auto are = [&](RoomType p, RoomType q) { return (a == p && b == q) || (a == q && b == p); };
  if (is_wet(a) && is_wet(b)) return 0.;
  if (are(kLiving, kKitchen) || are(kLiving, kDining) || are(kDining, kKitchen)) return 0.85;
  if (are(kBedroom, kBathroom)) return 0.4;
  if (are(kLiving, kStudy) || are(kBedroom, kStudy)) return 0.35;
  if (are(kKitchen, kLaundry)) return 0.3;
  if (is_wet(a) || is_wet(b)) return 0.02;
  return 0.1;
}

double affinity(const FloorPlan& plan, Pair pair) {
  return affinity(room_of(plan, pair.a).type, room_of(plan, pair.b).type);
}

std::vector<Pair> neighbours(const FloorPlan& plan) {
  std::vector<Pair> pairs;
  const Index count = static_cast<Index>(plan.rooms.size());
  for (Index a = 0; a < count; ++a) {
    for (Index b = 0; b < a; ++b) {
      if (touch(plan, a, b)) pairs.push_back({a, b});
    }
  }
  return pairs;
}

/// One door from every room to its longest stretch of corridor.
void join_rooms_to_passages(FloorPlan& plan, std::vector<bool>& reached, Rng& rng) {
  const Index count = static_cast<Index>(plan.rooms.size());
  for (Index room = 0; room < count; ++room) {
    if (is_passage(room_of(plan, room).type)) reached[static_cast<std::size_t>(room)] = true;
  }
  for (Index room = 0; room < count; ++room) {
    if (is_passage(room_of(plan, room).type)) continue;
    Index best = kOutside;
    float longest = kDoorWall;
    for (Index passage = 0; passage < count; ++passage) {
      if (!is_passage(room_of(plan, passage).type)) continue;
      const float length = shared_wall(room_of(plan, room).cell, room_of(plan, passage).cell).length();
      if (length >= longest) best = passage, longest = length;
    }
    const bool open = room_of(plan, room).type == RoomType::kLiving && rng.chance(0.35);
    if (best != kOutside)
      reached[static_cast<std::size_t>(room)] =
          join(plan, {room, best}, open ? OpeningKind::kArch : OpeningKind::kDoor, rng);
  }
}

/// Rooms away from the corridor open to the neighbour that suits them best.
void join_remaining_rooms(FloorPlan& plan, std::vector<bool>& reached, Rng& rng) {
  const std::vector<Pair> pairs = neighbours(plan);
  for (std::size_t round = 0; round < plan.rooms.size(); ++round) {
    Pair best{kOutside, kOutside};
    double most = 0.;
    for (Pair pair : pairs) {
      if (reached[static_cast<std::size_t>(pair.a)]) std::swap(pair.a, pair.b);
      if (reached[static_cast<std::size_t>(pair.a)] || !reached[static_cast<std::size_t>(pair.b)]) continue;
      if (is_wet(room_of(plan, pair.b).type)) continue;
      if (affinity(plan, pair) > most) most = affinity(plan, pair), best = pair;
    }
    if (best.a == kOutside) return;
    reached[static_cast<std::size_t>(best.a)] = join(plan, best, OpeningKind::kDoor, rng);
  }
}

void add_loop(FloorPlan& plan, Pair pair, Rng& rng) {
  if (room_of(plan, pair.b).type == RoomType::kBathroom) std::swap(pair.a, pair.b);
  join(plan, pair, affinity(plan, pair) > 0.5 && rng.chance(0.65) ? OpeningKind::kArch : OpeningKind::kDoor, rng);
}

/// Second ways between neighbours, by affinity, until there are up to three; at least one where walls allow.
void add_loops(FloorPlan& plan, Rng& rng) {
  std::vector<Pair> pairs = neighbours(plan);
  std::erase_if(pairs, [&](Pair p) {
    return joined(plan, p.a, p.b) || is_passage(room_of(plan, p.a).type) || is_passage(room_of(plan, p.b).type);
  });
  shuffle(rng, pairs);
  std::stable_sort(pairs.begin(), pairs.end(), [&](Pair p, Pair q) { return affinity(plan, p) > affinity(plan, q); });
  for (const Pair pair : pairs) {
    if (plan.loops() < 3 && rng.chance(affinity(plan, pair))) add_loop(plan, pair, rng);
  }
  for (const Pair pair : pairs) {
    if (plan.loops() >= 1) return;
    if (affinity(plan, pair) > 0.05 && !joined(plan, pair.a, pair.b)) add_loop(plan, pair, rng);
  }
}

/// Stretches of a room's sides that no other room touches.
std::vector<SharedWall> outer_walls(const FloorPlan& plan, Index room) {
  const Rect cell = room_of(plan, room).cell;
  const std::array<SharedWall, 4> sides{{{Side::kWest, cell.x0, cell.z0, cell.z1},
                                         {Side::kEast, cell.x1, cell.z0, cell.z1},
                                         {Side::kNorth, cell.z0, cell.x0, cell.x1},
                                         {Side::kSouth, cell.z1, cell.x0, cell.x1}}};
  std::vector<SharedWall> walls(sides.begin(), sides.end());
  for (Index other = 0; other < static_cast<Index>(plan.rooms.size()); ++other) {
    if (other == room) continue;
    const SharedWall shared = shared_wall(cell, room_of(plan, other).cell);
    std::vector<SharedWall> rest;
    for (SharedWall wall : walls) {
      if (shared.length() <= 0.f || wall.side != shared.side) {
        rest.push_back(wall);
        continue;
      }
      if (shared.low > wall.low) rest.push_back({wall.side, wall.line, wall.low, std::min(wall.high, shared.low)});
      if (shared.high < wall.high) rest.push_back({wall.side, wall.line, std::max(wall.low, shared.high), wall.high});
    }
    walls = rest;
  }
  return walls;
}

void add_entrance(FloorPlan& plan, Rng& rng) {
  for (const auto wanted :
       {RoomType::kHall, RoomType::kCorridor, RoomType::kLiving, RoomType::kDining, RoomType::kKitchen}) {
    for (Index room = 0; room < static_cast<Index>(plan.rooms.size()); ++room) {
      if (room_of(plan, room).type != wanted) continue;
      for (const SharedWall& wall : outer_walls(plan, room)) {
        if (wall.length() < 1.3f) continue;
        const std::optional<float> low = try_position(wall, 0.95f, rng);
        if (!low) continue;
        Opening door{OpeningKind::kEntrance, room, kOutside, wall.side, wall.line, *low, *low + 0.95f};
        door.hinge_low = rng.chance(0.5);
        plan.openings.push_back(door);
        return;
      }
    }
  }
}

struct WindowStyle {
  float narrow, wide, sill_low, sill_high, top;
  double chance;
};

WindowStyle window_style(RoomType type) {
  switch (type) {
    case RoomType::kLiving: return {1.5f, 2.6f, 0.3f, 0.85f, 2.3f, 1.};
    case RoomType::kBathroom:
    case RoomType::kLaundry: return {0.5f, 0.9f, 1.3f, 1.5f, 2.15f, 0.8};
    case RoomType::kKitchen: return {1.0f, 1.6f, 1.1f, 1.15f, 2.15f, 1.};
    case RoomType::kCorridor:
    case RoomType::kHall: return {0.7f, 1.2f, 0.85f, 1.0f, 2.15f, 0.6};
    default: return {1.1f, 2.0f, 0.75f, 0.95f, 2.2f, 1.};
  }
}

void add_windows(FloorPlan& plan, Index room, Rng& rng) {
  const WindowStyle style = window_style(room_of(plan, room).type);
  const float bottom = snap(range(rng, style.sill_low, style.sill_high));
  for (const SharedWall& wall : outer_walls(plan, room)) {
    if (!rng.chance(style.chance)) continue;
    const int count = std::max(1, static_cast<int>(wall.length() / 4.2f));
    const float share = wall.length() / static_cast<float>(count);
    const float width = snap(std::min(range(rng, style.narrow, style.wide), share - 0.7f));
    if (width < 0.45f) continue;
    for (int i = 0; i < count; ++i) {
      const float slack = std::max(0.f, 0.3f * (share - width - 0.7f));
      const float low =
          snap(wall.low + share * (static_cast<float>(i) + 0.5f) - 0.5f * width + range(rng, -slack, slack));
      if (is_taken(plan, wall.line, runs_along_x(wall.side), low, low + width)) continue;
      plan.openings.push_back(
          {OpeningKind::kWindow, room, kOutside, wall.side, wall.line, low, low + width, bottom, style.top});
    }
  }
}

void try_openings(FloorPlan& plan, Rng& rng) {
  std::vector<bool> reached(plan.rooms.size(), false);
  join_passages(plan);
  join_rooms_to_passages(plan, reached, rng);
  join_remaining_rooms(plan, reached, rng);
  add_loops(plan, rng);
  add_entrance(plan, rng);
  for (Index room = 0; room < static_cast<Index>(plan.rooms.size()); ++room) add_windows(plan, room, rng);
}

bool is_good(const FloorPlan& plan) {
  const auto has_entrance = [](const Opening& o) { return o.kind == OpeningKind::kEntrance; };
  if (plan.loops() < 0 || std::none_of(plan.openings.begin(), plan.openings.end(), has_entrance)) return false;
  for (Index room = 0; room < static_cast<Index>(plan.rooms.size()); ++room) {
    if (!RoomFloor(plan, room).is_walkable()) return false;
  }
  return true;
}

}  // namespace

void add_openings(FloorPlan& plan, std::uint64_t seed) {
  for (std::uint64_t attempt = 0; attempt < 200; ++attempt) {
    Rng rng = stream(seed, Stream::kOpenings, attempt);
    plan.openings.clear();
    try_openings(plan, rng);
    // Most plans allow a loop; when none came up in many tries this one does not.
    if (is_good(plan) && (plan.loops() > 0 || attempt > 30)) return;
  }
}

}  // namespace wiw::apartment
