// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <algorithm>
#include <cstdint>
#include <string>
#include <vector>

#include "wiw/apartment/apartment.hpp"
#include "wiw/apartment/room_type.hpp"

namespace wiw::apartment {

constexpr float kInnerWall = 0.12f;  // between rooms
constexpr float kOuterWall = 0.30f;  // to the outside; rooms lose half an inner wall on every side alike
constexpr float kDoorWall = 1.35f;   // shortest shared wall that takes a door
constexpr std::int32_t kOutside = -1;

/// Axis-aligned rectangle in the xz plane, metres.
struct Rect {
  float x0 = 0.f, z0 = 0.f, x1 = 0.f, z1 = 0.f;
  [[nodiscard]] float width() const { return x1 - x0; }
  [[nodiscard]] float depth() const { return z1 - z0; }
  [[nodiscard]] float area() const { return width() * depth(); }
  [[nodiscard]] Rect grown(float by) const { return {x0 - by, z0 - by, x1 + by, z1 + by}; }
  [[nodiscard]] bool overlaps(const Rect& o) const { return x0 < o.x1 && o.x0 < x1 && z0 < o.z1 && o.z0 < z1; }
  bool operator==(const Rect&) const = default;
  [[nodiscard]] bool contains(const Rect& o) const { return o.x0 >= x0 && o.x1 <= x1 && o.z0 >= z0 && o.z1 <= z1; }
};

/// Overlaps nothing.
constexpr Rect kNowhere{1e9f, 1e9f, 1e9f, 1e9f};

/// Sides of a room, named by the direction in which the wall lies as seen from inside.
enum class Side : int { kWest = 0, kEast = 1, kNorth = 2, kSouth = 3 };  // -x, +x, -z, +z
constexpr bool runs_along_x(Side side) { return side == Side::kNorth || side == Side::kSouth; }
constexpr Side opposite(Side side) { return static_cast<Side>(static_cast<int>(side) ^ 1); }

struct PlanRoom {
  RoomType type = RoomType::kLiving;
  std::string name;  // "bedroom 2"
  Rect cell;         // to the middle of the walls
  [[nodiscard]] Rect inside() const { return cell.grown(-kInnerWall / 2); }
};

enum class OpeningKind { kDoor, kArch, kEntrance, kWindow };

/// Hole in a wall. `room_a` is where a door leaf swings to and what a window lights.
struct Opening {
  OpeningKind kind = OpeningKind::kDoor;
  std::int32_t room_a = kOutside;
  std::int32_t room_b = kOutside;
  Side side = Side::kNorth;         // of room_a
  float line = 0.f;                 // coordinate of the middle of the wall (between rooms) or of the cell's edge
  float low = 0.f, high = 0.f;      // interval along the wall
  float bottom = 0.f, top = 2.05f;  // interval in height
  bool hinge_low = true;            // door leaf hangs at `low`
  float angle = 0.f;                // radians the leaf is open
  [[nodiscard]] float width() const { return high - low; }
  [[nodiscard]] bool passable() const { return kind == OpeningKind::kDoor || kind == OpeningKind::kArch; }
};

struct FloorPlan {
  std::vector<PlanRoom> rooms;
  std::vector<Opening> openings;
  float ceiling = 2.6f;
  std::string signature;  // see ApartmentIdentity::layout
  [[nodiscard]] float area() const;
  /// Number of independent cycles of the graph of rooms and passages.
  [[nodiscard]] int loops() const;
};

/// Rooms without openings; `signature` belongs to `split` alone.
FloorPlan make_layout(std::uint64_t seed, Split split);
/// Adds doors, arches, the entrance and windows such that one can walk from door to door in every empty room.
void add_openings(FloorPlan& plan, std::uint64_t seed);

/// Side of `room` (one of the two) on which the opening lies.
inline Side side_in(const Opening& opening, std::int32_t room) {
  return opening.room_a == room ? opening.side : opposite(opening.side);
}
/// Floor of `room` in front of the opening, `reach` deep from the wall's surface.
Rect threshold(const FloorPlan& plan, const Opening& opening, std::int32_t room, float reach);
/// Floor that a door's leaf sweeps in room_a; nowhere for openings without a leaf.
Rect swing(const FloorPlan& plan, const Opening& opening);

inline FloorPlan make_floor_plan(std::uint64_t seed, Split split) {
  FloorPlan plan = make_layout(seed, split);
  add_openings(plan, seed);
  return plan;
}

/// Interval shared by the walls of two cells, low > high when they do not touch; `side` is that of the first.
struct SharedWall {
  Side side = Side::kWest;
  float line = 0.f, low = 1.f, high = 0.f;
  [[nodiscard]] float length() const { return high - low; }
};
SharedWall shared_wall(const Rect& a, const Rect& b);

}  // namespace wiw::apartment
