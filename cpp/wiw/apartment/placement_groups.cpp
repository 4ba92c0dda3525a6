// SPDX-License-Identifier: Apache-2.0
// Pieces that go with others: companions, kitchens, what hangs on walls, lamps.
#include <cmath>

#include "wiw/apartment/placement.hpp"
#include "wiw/core/intrinsics.hpp"

namespace wiw::apartment {

namespace {

constexpr float kPiF = static_cast<float>(kPi);
constexpr std::array<Side, 4> kSides{Side::kWest, Side::kEast, Side::kNorth, Side::kSouth};

/// A point of a piece's frame in the room.
Vec3 in_room(const PlacedPiece& piece, float x, float z) {
  const float c = std::cos(piece.yaw), s = std::sin(piece.yaw);
  return piece.position + Vec3(c * x + s * z, 0.f, -s * x + c * z);
}

/// Wall behind a piece that was put there by place_at_wall.
Side wall_behind(const PlacedPiece& piece) {
  for (const Side side : kSides) {
    if (std::abs(yaw_from_wall(side) - piece.yaw) < 0.01f) return side;
  }
  return Side::kNorth;
}

float along_wall(Side side, const Vec3& position) { return runs_along_x(side) ? position.x() : position.z(); }

void place_beside(RoomPlan& room, const PlacedPiece& owner, PlacedPiece piece, int most) {
  const Side side = wall_behind(owner);
  const float reach = 0.5f * (owner.size.x() + piece.size.x()) + 0.03f, middle = along_wall(side, owner.position);
  int placed = 0;
  for (const float sign : {-1.f, 1.f}) {
    if (placed < most && room.place_at_wall(piece, side, middle + sign * reach)) {
      ++placed;
      place_companions(room, room.pieces.size() - 1);
    }
  }
}

/// Chairs along the sides of a table, one every 0.6 m, and at its ends, half pushed in.
void place_around(RoomPlan& room, const PlacedPiece& owner, PlacedPiece piece, int most) {
  const float hx = 0.5f * owner.size.x(), hz = 0.5f * owner.size.z(),
              out = 0.5f * piece.size.z() - range(room.rng, 0.08f, 0.2f);
  struct Seat {
    float x, z, yaw;
  };
  std::vector<Seat> seats;
  const int along = std::max(1, static_cast<int>((owner.size.x() - 0.1f) / 0.58f));
  for (int i = 0; i < along; ++i) {
    const float x = owner.size.x() * ((static_cast<float>(i) + 0.5f) / static_cast<float>(along) - 0.5f);
    seats.push_back({x, -hz - out, 0.f});
    seats.push_back({x, hz + out, kPiF});
  }
  seats.push_back({-hx - out, 0, 0.5f * kPiF});
  seats.push_back({hx + out, 0, -0.5f * kPiF});
  for (const Seat& seat : seats) {
    if (most-- == 0) return;
    piece.position = in_room(owner, seat.x, seat.z);
    piece.yaw = owner.yaw + seat.yaw + range(room.rng, -0.12f, 0.12f);
    if (!room.floor.fits_with(footprint(piece), footprint(owner))) continue;
    room.pieces.push_back(piece);
    room.floor.stand(footprint(piece), {});
  }
}

void place_before(RoomPlan& room, const PlacedPiece& owner, PlacedPiece piece) {
  piece.position = in_room(owner, range(room.rng, -0.1f, 0.1f), 0.5f * owner.size.z() + 0.3f * piece.size.z());
  piece.yaw = owner.yaw + kPiF + range(room.rng, -0.5f, 0.5f);
  if (!room.floor.fits_with(footprint(piece), footprint(owner))) return;
  room.floor.stand(footprint(piece), {});
  room.pieces.push_back(piece);
}

void place_ahead(RoomPlan& room, const PlacedPiece& owner, PlacedPiece piece, float gap) {
  piece.position = in_room(owner, 0.f, 0.5f * (owner.size.z() + piece.size.z()) + gap);
  piece.yaw = owner.yaw;
  const Rect body = footprint(piece);
  if (!room.floor.fits_with(body, footprint(owner))) return;
  room.floor.stand(body, {});
  room.pieces.push_back(piece);
}

void place_under(RoomPlan& room, const PlacedPiece& owner, PlacedPiece piece) {
  const bool table = catalogue()[owner.category].mount == Mount::kCentre;
  piece.yaw = owner.yaw;
  if (table)
    piece.size = {owner.size.x() + 1.1f, piece.size.y(), owner.size.z() + 1.1f};
  else
    piece.size.x() = std::max(piece.size.x(), owner.size.x() + 0.4f);
  for (int shrink = 0; shrink < 5; ++shrink) {
    piece.position = in_room(owner, 0.f, table ? 0.f : 0.5f * owner.size.z() + 0.28f * piece.size.z());
    if (room.floor.may_lie(footprint(piece).grown(0.02f))) {
      room.pieces.push_back(piece);
      return;
    }
    piece.size.x() *= 0.87f, piece.size.z() *= 0.87f;
  }
}

void place_opposite(RoomPlan& room, const PlacedPiece& owner, const PlacedPiece& piece) {
  const Side facing = opposite(wall_behind(owner));
  if (place_at_walls(room, piece, &facing, along_wall(facing, owner.position)) || place_at_walls(room, piece)) {
    place_companions(room, room.pieces.size() - 1);
  }
}

void place_above(RoomPlan& room, const PlacedPiece& owner, const PlacedPiece& piece) {
  const float bottom = std::max(catalogue()[piece.category].height, owner.size.y() + 0.15f);
  room.hang(piece, wall_behind(owner), along_wall(wall_behind(owner), owner.position), bottom);
}

void place_companion(RoomPlan& room, std::size_t index, const Companion& companion) {
  const PlacedPiece owner = room.pieces[index];
  PlacedPiece piece = room.design(category_index(companion.category));
  switch (companion.slot) {
    case Slot::kBeside: return place_beside(room, owner, piece, companion.most);
    case Slot::kAround: return place_around(room, owner, piece, companion.most);
    case Slot::kBefore: return place_before(room, owner, piece);
    case Slot::kAhead: return place_ahead(room, owner, piece, 0.38f);
    case Slot::kFoot: return place_ahead(room, owner, piece, 0.03f);
    case Slot::kUnder: return place_under(room, owner, piece);
    case Slot::kOpposite: return place_opposite(room, owner, piece);
    case Slot::kAbove: return place_above(room, owner, piece);
    case Slot::kOnTop:
      piece.parent = static_cast<int>(index);
      room.pieces.push_back(piece);
      return;
  }
}

}  // namespace

void place_companions(RoomPlan& room, std::size_t piece) {
  const Category& row = catalogue()[room.pieces[piece].category];
  for (const Companion& companion : row.companions) {
    if (room.rng.chance(companion.chance)) place_companion(room, piece, companion);
  }
}

void place_windows(RoomPlan& room) {
  const bool curtains = !is_wet(room.type()) && !is_passage(room.type()) &&
                        room.rng.chance(room.type() == RoomType::kKitchen ? 0.3 : 0.8);
  const PlacedPiece curtain = room.design(category_index("curtain"));
  PlacedPiece radiator = room.design(category_index("radiator"));
  const bool heated = room.rng.chance(0.75);
  for (const Opening& o : room.plan.openings) {
    if (o.kind != OpeningKind::kWindow || o.room_a != room.room) continue;
    const float middle = 0.5f * (o.low + o.high);
    radiator.size.x() = std::min(1.3f, 0.8f * o.width());
    if (heated && o.bottom > 0.72f) room.place_at_wall(radiator, o.side, middle);
    if (!curtains) continue;
    PlacedPiece piece = curtain;
    const float bottom = o.bottom > 0.6f && room.type() == RoomType::kKitchen ? o.bottom - 0.1f : 0.03f;
    piece.size.x() = std::min({o.width() + 0.5f, 2.f * (middle - room.floor.begin(o.side)) - 0.06f,
                               2.f * (room.floor.end(o.side) - middle) - 0.06f});
    piece.size.y() = std::min(o.top + 0.12f, room.plan.ceiling - 0.06f) - bottom;
    const Rect place = room.floor.at_wall(o.side, middle - 0.1f, middle + 0.1f, 0.11f, 0.1f);
    piece.position = {0.5f * (place.x0 + place.x1), bottom, 0.5f * (place.z0 + place.z1)};
    piece.yaw = yaw_from_wall(o.side);
    room.pieces.push_back(piece);
    const float half = 0.5f * piece.size.x();
    const float share = 0.36f * piece.size.x();  // the cloth gathers at both ends; low furniture may stand between
    for (const auto& [a, b] :
         {std::pair{middle - half, middle - half + share}, std::pair{middle + half - share, middle + half}}) {
      room.floor.cover({o.side, a, b, bottom < 0.5f ? 0.05f : o.bottom, o.top + 0.2f});
    }
  }
}

void place_hung(RoomPlan& room) {
  for (std::size_t i = 0; i < catalogue().size(); ++i) {
    const Category& row = catalogue()[i];
    if (row.mount != Mount::kHung) continue;
    for (const Prior& prior : row.priors) {
      if (prior.room != room.type()) continue;
      for (int n = 0; n < prior.most; ++n) {
        if (!room.rng.chance(n == 0 ? prior.chance : 0.7 * prior.chance)) break;
        const PlacedPiece piece = room.design(i);
        const float height = std::string(row.name) == "picture" ? 1.55f - 0.5f * piece.size.y() : row.height;
        for (int attempt = 0; attempt < 24; ++attempt) {
          const Side side = pick(room.rng, kSides);
          if (room.hang(piece, side, range(room.rng, room.floor.begin(side), room.floor.end(side)), height)) break;
        }
      }
    }
  }
}

void place_lamps(RoomPlan& room) {
  const Rect& inside = room.floor.inside();
  const bool pendant = !is_wet(room.type()) && !is_passage(room.type()) && room.rng.chance(0.55);
  PlacedPiece lamp = room.design(category_index(pendant ? "pendant lamp" : "ceiling lamp"));
  const bool wide = inside.width() > inside.depth();
  const int count = std::max(1, static_cast<int>(std::lround(std::max(inside.width(), inside.depth()) / 4.6f)));
  const auto table = std::find_if(room.pieces.begin(), room.pieces.end(),
                                  [](const PlacedPiece& p) { return catalogue()[p.category].mount == Mount::kCentre; });
  for (int i = 0; i < count; ++i) {
    const float t = (static_cast<float>(i) + 0.5f) / static_cast<float>(count);
    const float y = room.plan.ceiling - lamp.size.y();
    lamp.position = {inside.x0 + inside.width() * (wide ? t : 0.5f), y, inside.z0 + inside.depth() * (wide ? 0.5f : t)};
    if (count == 1 && pendant && table != room.pieces.end())
      lamp.position = {table->position.x(), y, table->position.z()};
    room.pieces.push_back(lamp);
  }
}

}  // namespace wiw::apartment
