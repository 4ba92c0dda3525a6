// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <vector>

#include "wiw/apartment/floor_plan.hpp"

namespace wiw::apartment {

/// Part of a wall that is taken: an interval along it and one in height.
struct WallPatch {
  Side side = Side::kWest;
  float low = 0.f, high = 0.f, bottom = 0.f, top = 0.f;
};

/// The free space of one room: floor, walls, and walkable passages.
class RoomFloor {
 public:
  RoomFloor(const FloorPlan& plan, std::int32_t room);

  /// Whether all doors of the room can be reached from each other.
  [[nodiscard]] bool is_walkable() const { return !doorsteps_.empty() && stays_walkable(kNowhere); }
  [[nodiscard]] const Rect& inside() const { return inside_; }
  /// Whether a piece may stand on `body` with `front` kept free, and people can still walk from door to door.
  [[nodiscard]] bool fits(const Rect& body, const Rect& front) const;
  /// The same for a piece that belongs to another one: it may stand where its owner keeps floor free, and reach under
  /// the owner's own body.
  [[nodiscard]] bool fits_with(const Rect& body, const Rect& owner) const;
  [[nodiscard]] bool wall_is_free(const WallPatch& patch) const;
  void stand(const Rect& body, const Rect& front);
  void cover(const WallPatch& patch) { covered_.push_back(patch); }
  /// Whether a flat thing may lie here: inside and not where door leaves sweep.
  [[nodiscard]] bool may_lie(const Rect& area) const;

  [[nodiscard]] float begin(Side side) const { return runs_along_x(side) ? inside_.x0 : inside_.z0; }
  [[nodiscard]] float end(Side side) const { return runs_along_x(side) ? inside_.x1 : inside_.z1; }
  /// Rectangle at a wall: `out` deep from `gap`, from `low` to `high` along it.
  [[nodiscard]] Rect at_wall(Side side, float low, float high, float gap, float out) const;

 private:
  [[nodiscard]] bool stays_walkable(const Rect& extra) const;
  void add_leaf(const Opening& door);

  Rect inside_;
  std::vector<Rect> bodies_, fronts_, ways_, leaves_, sweeps_;
  std::vector<std::pair<float, float>> doorsteps_;  // points (x, z) that must stay connected
  std::vector<WallPatch> covered_;
};

}  // namespace wiw::apartment
