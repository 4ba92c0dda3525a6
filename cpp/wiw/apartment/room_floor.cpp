// SPDX-License-Identifier: Apache-2.0
#include "wiw/apartment/room_floor.hpp"

#include <cmath>
#include <cstdint>

namespace wiw::apartment {

namespace {

constexpr float kCell = 0.05f;
constexpr float kPerson = 0.3f;      // radius: passages are 0.6 m wide
constexpr float kDoorReach = 0.75f;  // floor kept free before a door

/// Raster of the points where the middle of a person may be.
class WalkGrid {
 public:
  explicit WalkGrid(const Rect& inside)
      : inside_(inside),
        columns_(static_cast<int>(inside.width() / kCell)),
        rows_(static_cast<int>(inside.depth() / kCell)),
        cells_(static_cast<std::size_t>(columns_ * rows_), kFree) {
    const float x0 = inside.x0, x1 = inside.x1, z0 = inside.z0, z1 = inside.z1, r = kPerson - 0.01f;
    for (const Rect& wall :
         {Rect{x0, z0, x0 + r, z1}, Rect{x1 - r, z0, x1, z1}, Rect{x0, z0, x1, z0 + r}, Rect{x0, z1 - r, x1, z1}})
      fill(wall);
  }

  void block(const Rect& body) { fill(body.grown(kPerson)); }

  /// Number of cells reached from a point.
  int flood(std::pair<float, float> from) {
    std::vector<int> open;
    const auto visit = [&](int column, int row) {
      if (column < 0 || row < 0 || column >= columns_ || row >= rows_) return;
      auto& cell = cells_[static_cast<std::size_t>(row * columns_ + column)];
      if (cell != kFree) return;
      cell = kReached;
      open.push_back(row * columns_ + column);
    };
    visit(column_of(from.first), row_of(from.second));
    int count = 0;
    while (!open.empty()) {
      const int at = open.back();
      open.pop_back();
      ++count;
      const int column = at % columns_, row = at / columns_;
      visit(column - 1, row), visit(column + 1, row), visit(column, row - 1), visit(column, row + 1);
    }
    return count;
  }

  [[nodiscard]] bool reached(std::pair<float, float> p) const {
    return cells_[static_cast<std::size_t>(row_of(p.second) * columns_ + column_of(p.first))] == kReached;
  }
  [[nodiscard]] int free() const {
    return static_cast<int>(std::count_if(cells_.begin(), cells_.end(), [](auto c) { return c != kBlocked; }));
  }

 private:
  static constexpr std::uint8_t kFree = 0, kBlocked = 1, kReached = 2;
  [[nodiscard]] int column_of(float x) const {
    return std::clamp(static_cast<int>((x - inside_.x0) / kCell), 0, columns_ - 1);
  }
  [[nodiscard]] int row_of(float z) const {
    return std::clamp(static_cast<int>((z - inside_.z0) / kCell), 0, rows_ - 1);
  }
  void fill(const Rect& area) {
    // A cell is blocked if its middle lies in the area.
    const int c0 = std::max(0, static_cast<int>(std::ceil((area.x0 - inside_.x0) / kCell - 0.5f)));
    const int c1 = std::min(columns_ - 1, static_cast<int>(std::floor((area.x1 - inside_.x0) / kCell - 0.5f)));
    const int r0 = std::max(0, static_cast<int>(std::ceil((area.z0 - inside_.z0) / kCell - 0.5f)));
    const int r1 = std::min(rows_ - 1, static_cast<int>(std::floor((area.z1 - inside_.z0) / kCell - 0.5f)));
    for (int r = r0; r <= r1; ++r) {
      for (int c = c0; c <= c1; ++c) cells_[static_cast<std::size_t>(r * columns_ + c)] = kBlocked;
    }
  }

  Rect inside_;
  int columns_, rows_;
  std::vector<std::uint8_t> cells_;
};

}  // namespace

RoomFloor::RoomFloor(const FloorPlan& plan, std::int32_t room)
    : inside_(plan.rooms[static_cast<std::size_t>(room)].inside()) {
  for (const Opening& o : plan.openings) {
    if (o.room_a != room && o.room_b != room) continue;
    const Side side = side_in(o, room);
    const float margin = o.kind == OpeningKind::kWindow ? 0.03f : 0.08f;
    covered_.push_back({side, o.low - margin, o.high + margin, o.bottom > 0.f ? o.bottom - 0.05f : 0.f, o.top + 0.1f});
    if (o.kind == OpeningKind::kWindow) continue;
    ways_.push_back(threshold(plan, o, room, kDoorReach).grown(0.03f));
    if (o.passable()) {
      const Rect step = threshold(plan, o, room, 2 * 0.35f);
      doorsteps_.emplace_back(0.5f * (step.x0 + step.x1), 0.5f * (step.z0 + step.z1));
    }
    if (o.kind == OpeningKind::kDoor && o.room_a == room) {
      ways_.push_back(swing(plan, o));
      sweeps_.push_back(swing(plan, o));
      add_leaf(o);
    }
  }
}

/// The open leaf as a chain of small squares.
void RoomFloor::add_leaf(const Opening& door) {
  const float into = (door.side == Side::kWest || door.side == Side::kNorth) ? 1.f : -1.f;
  const float along = door.hinge_low ? 1.f : -1.f, hinge = door.hinge_low ? door.low : door.high;
  for (int i = 0; i <= 8; ++i) {
    const float reach = door.width() * static_cast<float>(i) / 8.f;
    const float a = hinge + along * reach * std::cos(door.angle),
                b = door.line + into * (kInnerWall / 2 + reach * std::sin(door.angle));
    leaves_.push_back(runs_along_x(door.side) ? Rect{a, b, a, b} : Rect{b, a, b, a});
  }
}

bool RoomFloor::stays_walkable(const Rect& extra) const {
  WalkGrid grid(inside_);
  grid.block(extra);
  for (const Rect& body : bodies_) grid.block(body);
  for (const Rect& leaf : leaves_) grid.block(leaf);
  const int reached = grid.flood(doorsteps_.front());
  const bool connected =
      std::all_of(doorsteps_.begin(), doorsteps_.end(), [&](const auto& step) { return grid.reached(step); });
  return connected && static_cast<float>(reached) >= 0.8f * static_cast<float>(grid.free());
}

namespace {

bool hits(const Rect& area, const std::vector<Rect>& others) {
  return std::any_of(others.begin(), others.end(), [&](const Rect& other) { return area.overlaps(other); });
}

}  // namespace

bool RoomFloor::fits(const Rect& body, const Rect& front) const {
  if (!inside_.contains(front) || hits(body, fronts_) || hits(front, bodies_)) return false;
  return fits_with(body, kNowhere);
}

bool RoomFloor::fits_with(const Rect& body, const Rect& owner) const {
  if (!inside_.contains(body) || hits(body, ways_)) return false;
  const bool blocked = std::any_of(bodies_.begin(), bodies_.end(),
                                   [&](const Rect& other) { return other != owner && body.overlaps(other); });
  return !blocked && (doorsteps_.empty() || stays_walkable(body));
}

bool RoomFloor::wall_is_free(const WallPatch& patch) const {
  return std::none_of(covered_.begin(), covered_.end(), [&](const WallPatch& other) {
    return other.side == patch.side && patch.low < other.high && other.low < patch.high && patch.bottom < other.top &&
           other.bottom < patch.top;
  });
}

void RoomFloor::stand(const Rect& body, const Rect& front) {
  bodies_.push_back(body);
  if (front.area() > 1e-4f) fronts_.push_back(front);
}

bool RoomFloor::may_lie(const Rect& area) const {
  return inside_.contains(area) &&
         std::none_of(sweeps_.begin(), sweeps_.end(), [&](const Rect& sweep) { return sweep.overlaps(area); });
}

Rect RoomFloor::at_wall(Side side, float low, float high, float gap, float out) const {
  switch (side) {
    case Side::kWest: return {inside_.x0 + gap, low, inside_.x0 + gap + out, high};
    case Side::kEast: return {inside_.x1 - gap - out, low, inside_.x1 - gap, high};
    case Side::kNorth: return {low, inside_.z0 + gap, high, inside_.z0 + gap + out};
    case Side::kSouth: return {low, inside_.z1 - gap - out, high, inside_.z1 - gap};
  }
  return {};
}

}  // namespace wiw::apartment
