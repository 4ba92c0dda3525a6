// SPDX-License-Identifier: Apache-2.0
#include "wiw/apartment/placement.hpp"

#include <cmath>

#include "wiw/core/intrinsics.hpp"

namespace wiw::apartment {

namespace {

constexpr float kGap = 0.02f;  // behind furniture, for the skirting board
constexpr std::array<Side, 4> kSides{Side::kWest, Side::kEast, Side::kNorth, Side::kSouth};

struct Spot {
  Side side;
  float middle;
  float score;
};

/// Places along all walls, best first.
std::vector<Spot> wall_spots(RoomPlan& room, const PlacedPiece& piece, const Side* wanted, float near) {
  std::vector<Spot> spots;
  const bool corner = catalogue()[piece.category].mount == Mount::kCorner;
  for (const Side side : kSides) {
    if (wanted != nullptr && side != *wanted) continue;
    const float begin = room.floor.begin(side) + 0.5f * piece.size.x() + 0.01f,
                end = room.floor.end(side) - 0.5f * piece.size.x() - 0.01f;
    const float liking = range(room.rng, 0.f, 0.8f);
    const int steps = std::max(0, static_cast<int>((end - begin) / 0.1f));
    for (int i = 0; i <= steps && end >= begin; ++i) {
      const float middle =
          steps == 0 ? 0.5f * (begin + end) : begin + (end - begin) * static_cast<float>(i) / static_cast<float>(steps);
      const float to_corner = std::min(middle - begin, end - middle),
                  to_middle = std::abs(middle - 0.5f * (begin + end));
      float score = liking + range(room.rng, 0.f, 0.5f);
      if (wanted != nullptr)
        score -= 2.f * std::abs(middle - near);
      else
        score -= corner ? 1.5f * to_corner : 0.4f * to_middle;
      spots.push_back({side, middle, score});
    }
  }
  std::stable_sort(spots.begin(), spots.end(), [](const Spot& a, const Spot& b) { return a.score > b.score; });
  return spots;
}

/// Free-standing pieces: anywhere in the room, along or across, near the middle first.
bool place_in_the_open(RoomPlan& room, const PlacedPiece& piece, float around) {
  const Rect& inside = room.floor.inside();
  std::vector<PlacedPiece> spots;
  std::vector<std::pair<float, std::size_t>> order;
  for (int turn = 0; turn < 2; ++turn) {
    for (int i = 1; i < 12; ++i) {
      for (int j = 1; j < 12; ++j) {
        PlacedPiece spot = piece;
        spot.yaw = static_cast<float>(turn) * static_cast<float>(kPi / 2);
        spot.position = {inside.x0 + inside.width() * static_cast<float>(i) / 12.f, 0,
                         inside.z0 + inside.depth() * static_cast<float>(j) / 12.f};
        const float off = std::hypot(static_cast<float>(i - 6), static_cast<float>(j - 6));
        order.emplace_back(0.25f * off + range(room.rng, 0.f, 0.6f), spots.size());
        spots.push_back(spot);
      }
    }
  }
  std::stable_sort(order.begin(), order.end());
  return std::any_of(order.begin(), order.end(),
                     [&](const auto& entry) { return room.stand_free(spots[entry.second], around); });
}

void place_category(RoomPlan& room, std::size_t index) {
  const Category& category = catalogue()[index];
  for (const Prior& prior : category.priors) {
    if (prior.room != room.type()) continue;
    for (int i = 0; i < prior.most; ++i) {
      if (!room.rng.chance(i == 0 ? prior.chance : 0.5 * prior.chance)) break;
      const PlacedPiece piece = room.design(index);
      // Chairs need as much room around a table as a person behind them.
      const bool placed = category.mount == Mount::kCentre
                              ? place_in_the_open(room, piece, 0.75f) || place_in_the_open(room, piece, 0.5f)
                              : place_at_walls(room, piece);
      if (!placed) break;
      place_companions(room, room.pieces.size() - 1);
    }
  }
}

}  // namespace

float yaw_from_wall(Side side) {
  constexpr float kQuarter = static_cast<float>(kPi / 2);
  switch (side) {
    case Side::kWest: return kQuarter;
    case Side::kEast: return -kQuarter;
    case Side::kNorth: return 0.f;
    case Side::kSouth: return 2 * kQuarter;
  }
  return 0.f;
}

Rect footprint(const PlacedPiece& piece) {
  const float c = std::abs(std::cos(piece.yaw)), s = std::abs(std::sin(piece.yaw));
  const float hx = 0.5f * (c * piece.size.x() + s * piece.size.z()),
              hz = 0.5f * (s * piece.size.x() + c * piece.size.z());
  return {piece.position.x() - hx, piece.position.z() - hz, piece.position.x() + hx, piece.position.z() + hz};
}

PlacedPiece RoomPlan::design(std::size_t category) {
  const Category& row = catalogue()[category];
  PlacedPiece piece{category, room};
  piece.key = stream_key({seed, static_cast<std::uint64_t>(Stream::kFurniture), static_cast<std::uint64_t>(room),
                          category, pieces.size()});
  Rng own(piece.key);
  for (int axis = 0; axis < 3; ++axis) piece.size[axis] = range(own, row.smallest[axis], row.largest[axis]);
  return piece;
}

bool RoomPlan::place_at_wall(PlacedPiece piece, Side side, float middle) {
  const Category& row = catalogue()[piece.category];
  const float half = 0.5f * piece.size.x();
  const Rect body = floor.at_wall(side, middle - half, middle + half, kGap, piece.size.z());
  const Rect front =
      row.front > 0.f ? floor.at_wall(side, middle - half, middle + half, kGap + piece.size.z(), row.front) : body;
  const WallPatch patch{side, middle - half, middle + half, 0.f, piece.size.y()};
  if (!floor.wall_is_free(patch) || !floor.fits(body, front)) return false;
  floor.stand(body, row.front > 0.f ? front : Rect{});
  floor.cover(patch);
  piece.position = {0.5f * (body.x0 + body.x1), 0.f, 0.5f * (body.z0 + body.z1)};
  piece.yaw = yaw_from_wall(side);
  pieces.push_back(piece);
  return true;
}

bool RoomPlan::stand_free(const PlacedPiece& piece, float front) {
  const Rect body = footprint(piece);
  if (!floor.fits(body, body.grown(front))) return false;
  floor.stand(body, {});
  pieces.push_back(piece);
  return true;
}

bool RoomPlan::hang(PlacedPiece piece, Side side, float middle, float height) {
  const float half = 0.5f * piece.size.x();
  const WallPatch patch{side, middle - half - 0.04f, middle + half + 0.04f, height - 0.05f,
                        height + piece.size.y() + 0.03f};
  if (patch.low < floor.begin(side) || patch.high > floor.end(side) || patch.top > plan.ceiling) return false;
  if (!floor.wall_is_free(patch)) return false;
  floor.cover(patch);
  const Rect place = floor.at_wall(side, middle - half, middle + half, 0.001f, piece.size.z());
  piece.position = {0.5f * (place.x0 + place.x1), height, 0.5f * (place.z0 + place.z1)};
  piece.yaw = yaw_from_wall(side);
  pieces.push_back(piece);
  return true;
}

bool place_at_walls(RoomPlan& room, const PlacedPiece& piece, const Side* wanted, float near) {
  const std::vector<Spot> spots = wall_spots(room, piece, wanted, near);
  return std::any_of(spots.begin(), spots.end(),
                     [&](const Spot& spot) { return room.place_at_wall(piece, spot.side, spot.middle); });
}

std::vector<PlacedPiece> place_furniture(const FloorPlan& plan, std::int32_t room, std::uint64_t seed) {
  RoomPlan state{plan, room, seed, RoomFloor(plan, room),
                 stream(seed, Stream::kRooms, static_cast<std::uint64_t>(room))};
  if (state.type() == RoomType::kKitchen) place_kitchen(state);
  place_windows(state);
  for (std::size_t i = 0; i < catalogue().size(); ++i) {
    const Mount mount = catalogue()[i].mount;
    if (mount == Mount::kWall || mount == Mount::kCorner || mount == Mount::kCentre) place_category(state, i);
  }
  place_hung(state);
  place_lamps(state);
  return state.pieces;
}

}  // namespace wiw::apartment
