// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <vector>

#include "wiw/apartment/furniture/catalogue.hpp"
#include "wiw/apartment/room_floor.hpp"

namespace wiw::apartment {

/// A piece of furniture before it is built: what, where, and the key of its design.
struct PlacedPiece {
  std::size_t category = 0;
  std::int32_t room = kOutside;
  Vec3 size = Vec3::Ones();
  Vec3 position = Vec3::Zero();  // middle of its footprint, lower edge
  float yaw = 0.f;               // radians about y; its front looks along +z at 0
  std::uint64_t key = 0;         // equal keys and sizes give equal pieces
  int parent = -1;               // index of the piece it stands on
};

/// Everything in a room but what stands on other furniture, which needs the built shapes.
std::vector<PlacedPiece> place_furniture(const FloorPlan& plan, std::int32_t room, std::uint64_t seed);

/// Floor rectangle under a piece.
Rect footprint(const PlacedPiece& piece);
/// Yaw of a piece with its back to a wall.
float yaw_from_wall(Side side);

/// Shared by the passes of place_furniture.
struct RoomPlan {
  const FloorPlan& plan;
  std::int32_t room;
  std::uint64_t seed;
  RoomFloor floor;
  Rng rng;
  std::vector<PlacedPiece> pieces{};

  [[nodiscard]] RoomType type() const { return plan.rooms[static_cast<std::size_t>(room)].type; }
  /// A piece of the category with a size of its own, not yet placed.
  PlacedPiece design(std::size_t category);
  /// Back to the wall with the middle at `middle`; false and unchanged if it does not fit.
  bool place_at_wall(PlacedPiece piece, Side side, float middle);
  bool stand_free(const PlacedPiece& piece, float front);
  bool hang(PlacedPiece piece, Side side, float middle, float height);
};

void place_windows(RoomPlan& room);
void place_kitchen(RoomPlan& room);
void place_companions(RoomPlan& room, std::size_t piece);
void place_hung(RoomPlan& room);
void place_lamps(RoomPlan& room);
/// At the best of the walls; `wanted` restricts it to one side, nearest to `near`.
bool place_at_walls(RoomPlan& room, const PlacedPiece& piece, const Side* wanted = nullptr, float near = 0.f);

}  // namespace wiw::apartment
