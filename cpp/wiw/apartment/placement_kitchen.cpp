// SPDX-License-Identifier: Apache-2.0
// Kitchens: a run of units along one or two walls, cabinets above.
#include <array>

#include "wiw/apartment/placement.hpp"

namespace wiw::apartment {

namespace {

constexpr std::array<Side, 4> kSides{Side::kWest, Side::kEast, Side::kNorth, Side::kSouth};

/// Longest stretch of a wall without doors, found by a sliding probe as deep and high as a counter.
struct Stretch {
  Side side = Side::kWest;
  float low = 0.f, high = 0.f;
  [[nodiscard]] float length() const { return high - low; }
};

Stretch longest_stretch(const RoomPlan& room, Side side) {
  constexpr float kStep = 0.05f;
  Stretch best{side}, run{side};
  bool open = false;
  // Rounding may add or drop a step; none is needed.
  // NOLINTNEXTLINE(bugprone-float-loop-counter,clang-analyzer-security.FloatLoopCounter)
  for (float at = room.floor.begin(side) + 0.01f; at + kStep <= room.floor.end(side); at += kStep) {
    const Rect probe = room.floor.at_wall(side, at, at + kStep, 0.02f, 0.62f);
    const bool free = room.floor.fits(probe, probe) && room.floor.wall_is_free({side, at, at + kStep, 0.f, 0.9f});
    if (free && !open) run.low = at;
    if (free) run.high = at + kStep;
    open = free;
    if (run.length() > best.length()) best = run;
  }
  return best;
}

struct KitchenUnit {
  const char* category;
  float width;
};

/// Sequence that fills `length`: the units that must be there, then worktop.
std::vector<KitchenUnit> fill(float length, std::vector<KitchenUnit>& needed) {
  std::vector<KitchenUnit> line;
  float left = length;
  const auto take = [&](KitchenUnit unit) {
    line.push_back(unit);
    left -= unit.width;
  };
  while (!needed.empty() && left >= needed.front().width + (line.empty() ? 0.f : 0.001f)) {
    const bool gap =
        !line.empty() && left - needed.front().width >= 0.45f && std::string(line.back().category) != "kitchen counter";
    if (gap) take({"kitchen counter", std::min(0.6f, left - needed.front().width)});
    if (left < needed.front().width) break;
    take(needed.front());
    needed.erase(needed.begin());
  }
  while (left >= 0.4f) {
    const float width = left >= 1.4f ? 0.8f : left > 1.f ? 0.5f * left : left;
    take({"kitchen counter", width});
  }
  return line;
}

void add_overhead(RoomPlan& room, const KitchenUnit& unit, Side side, float middle) {
  const bool stove = std::string(unit.category) == "stove";
  if (std::string(unit.category) == "refrigerator") return;
  PlacedPiece piece = room.design(category_index(stove ? "range hood" : "kitchen cabinet"));
  piece.size.x() = unit.width - 0.082f + 0.08f;
  const float height = catalogue()[piece.category].height;
  piece.size.y() = std::min(piece.size.y(), room.plan.ceiling - height - 0.05f);
  const float half = 0.5f * piece.size.x();
  const WallPatch patch{side, middle - half, middle + half, height - 0.05f, height + piece.size.y()};
  if (!room.floor.wall_is_free(patch)) return;
  room.floor.cover(patch);
  const Rect place = room.floor.at_wall(side, middle - half, middle + half, 0.001f, piece.size.z());
  piece.position = {0.5f * (place.x0 + place.x1), height, 0.5f * (place.z0 + place.z1)};
  piece.yaw = yaw_from_wall(side);
  room.pieces.push_back(piece);
}

void place_line(RoomPlan& room, const Stretch& stretch, const std::vector<KitchenUnit>& line, bool from_high,
                float height) {
  float at = from_high ? stretch.high : stretch.low;
  for (const KitchenUnit& unit : line) {
    PlacedPiece piece = room.design(category_index(unit.category));
    piece.size.x() = unit.width - 0.002f;
    if (std::string(unit.category) != "refrigerator") piece.size.y() = height;
    const float middle = from_high ? at - 0.5f * unit.width : at + 0.5f * unit.width;
    at += from_high ? -unit.width : unit.width;
    if (room.place_at_wall(piece, stretch.side, middle)) add_overhead(room, unit, stretch.side, middle);
  }
}

}  // namespace

void place_kitchen(RoomPlan& room) {
  std::vector<KitchenUnit> needed{{"kitchen sink", 0.8f}, {"stove", 0.6f}, {"refrigerator", 0.72f}};
  if (room.rng.chance(0.5)) std::swap(needed[0], needed[1]);
  if (room.rng.chance(0.5)) std::rotate(needed.begin(), needed.begin() + 2, needed.end());
  for (int line = 0; line < 3 && (line < 2 || !needed.empty()); ++line) {
    Stretch best;
    for (const Side side : kSides) {
      const Stretch stretch = longest_stretch(room, side);
      if (stretch.length() > best.length()) best = stretch;
    }
    if (best.length() < 0.6f) return;
    best.high = best.low + std::min(best.length(), line == 0 ? 4.2f : 2.4f);
    if (line > 0 && needed.empty() && room.rng.chance(0.5)) return;
    place_line(room, best, fill(best.length(), needed), room.rng.chance(0.5), 0.9f);
  }
}

}  // namespace wiw::apartment
