// SPDX-License-Identifier: Apache-2.0
// Rooms without openings: a kind of plan, an order of rooms, sizes.
#include <array>
#include <map>
#include <numeric>

#include "wiw/apartment/floor_plan.hpp"
#include "wiw/apartment/random.hpp"

namespace wiw::apartment {

namespace {

using Rooms = std::vector<RoomType>;

struct Sizes {
  float width;     // wanted length along the corridor
  float min_side;  // shortest usable side, inside
  float min_area;
};

Sizes sizes_of(RoomType type) {
  switch (type) {
    case RoomType::kLiving: return {5.0f, 3.0f, 14.5f};
    case RoomType::kDining: return {3.4f, 2.6f, 8.5f};
    case RoomType::kKitchen: return {3.1f, 2.2f, 7.5f};
    case RoomType::kBedroom: return {3.6f, 2.7f, 9.5f};
    case RoomType::kKids: return {3.1f, 2.4f, 8.0f};
    case RoomType::kStudy: return {2.8f, 2.2f, 7.0f};
    case RoomType::kBathroom: return {2.3f, 1.75f, 3.6f};
    case RoomType::kLaundry: return {1.9f, 1.5f, 2.8f};
    case RoomType::kHall: return {1.7f, 1.35f, 2.5f};
    case RoomType::kCorridor: return {1.3f, 1.05f, 2.f};
  }
  return {};
}

/// One slot of a row of rooms: a room, or a small room before the corridor with another one behind it.
struct RowSlot {
  RoomType front;
  bool split = false;
  RoomType back = RoomType::kLaundry;
};
using RoomRow = std::vector<RowSlot>;

char letter(RoomType type) { return "LDKBCSTUOH"[static_cast<std::size_t>(type)]; }

std::string text(const RoomRow& row, bool reversed = false) {
  std::string result;
  for (std::size_t i = 0; i < row.size(); ++i) {
    const RowSlot& slot = row[reversed ? row.size() - 1 - i : i];
    result += letter(slot.front);
    if (slot.split) result += letter(slot.back);
  }
  return result;
}

struct LayoutDraft {
  std::vector<PlanRoom> rooms;
  std::string signature;
  void add(RoomType type, Rect cell) { rooms.push_back({type, "", cell}); }
};

float wanted_width(const RoomRow& row) {
  return std::accumulate(row.begin(), row.end(), 0.f,
                         [](float sum, const RowSlot& s) { return sum + sizes_of(s.front).width; });
}

/// Cuts [x0, x1] x [z0, z1] into the rooms of a row; `corridor_low` tells on which side the front rooms are.
void add_row(LayoutDraft& draft, const RoomRow& row, Rect band, bool corridor_low, Rng& rng) {
  std::vector<float> widths;
  for (const RowSlot& slot : row) widths.push_back(sizes_of(slot.front).width * range(rng, 0.88f, 1.16f));
  const float scale = band.width() / std::accumulate(widths.begin(), widths.end(), 0.f);
  float x = band.x0;
  for (std::size_t i = 0; i < row.size(); ++i) {
    const float end = i + 1 == row.size() ? band.x1 : snap(x + widths[i] * scale);
    const Rect cell{x, band.z0, end, band.z1};
    if (row[i].split) {
      const float cut = snap(band.z0 + band.depth() * range(rng, 0.46f, 0.54f));
      const Rect low{x, band.z0, end, cut};
      const Rect high{x, cut, end, band.z1};
      draft.add(row[i].front, corridor_low ? low : high);
      draft.add(row[i].back, corridor_low ? high : low);
    } else {
      draft.add(row[i].front, cell);
    }
    x = end;
  }
}

Rooms make_program(Rng& rng) {
  Rooms rooms{RoomType::kLiving, RoomType::kKitchen, RoomType::kBathroom, RoomType::kBedroom};
  const auto extra = rng.below(4);
  const std::array<RoomType, 8> kOptional{RoomType::kBedroom, RoomType::kKids,    RoomType::kStudy,
                                          RoomType::kDining,  RoomType::kLaundry, RoomType::kBedroom,
                                          RoomType::kDining,  RoomType::kBathroom};
  std::map<RoomType, int> count;
  for (std::uint32_t i = 0; i < extra;) {
    const RoomType type = pick(rng, kOptional);
    if (++count[type] > 1) continue;
    rooms.push_back(type);
    ++i;
  }
  return rooms;
}

bool eats(RoomType type) { return type == RoomType::kLiving || type == RoomType::kDining; }

/// People cook next to where they eat.
bool kitchen_is_well_placed(const RoomRow& row) {
  for (std::size_t i = 0; i < row.size(); ++i) {
    if (row[i].front != RoomType::kKitchen) continue;
    return (i > 0 && eats(row[i - 1].front)) || (i + 1 < row.size() && eats(row[i + 1].front));
  }
  return true;
}

/// Joins the laundry behind a bathroom, or a second bathroom, into one slot in half of the plans.
RoomRow slots_of(const Rooms& rooms, Rng& rng) {
  RoomRow row;
  const bool join = rng.chance(0.6);
  for (const RoomType type : rooms) {
    const bool small = is_wet(type);
    if (join && small && !row.empty() && is_wet(row.back().front) && !row.back().split) {
      row.back().split = true;
      row.back().back = type;
      if (row.back().front == RoomType::kLaundry) std::swap(row.back().front, row.back().back);
    } else {
      row.push_back({type});
    }
  }
  return row;
}

/// Shares the rooms out to rows of wanted lengths.
std::vector<RoomRow> share_out(Rooms rooms, const std::vector<float>& lengths, Rng& rng) {
  std::vector<RoomRow> rows;
  for (int attempt = 0; attempt < 8; ++attempt) {
    shuffle(rng, rooms);
    std::vector<Rooms> lists(lengths.size());
    std::vector<float> left = lengths;
    for (const RoomType type : rooms) {
      const auto best = std::max_element(left.begin(), left.end()) - left.begin();
      lists[static_cast<std::size_t>(best)].push_back(type);
      left[static_cast<std::size_t>(best)] -= sizes_of(type).width;
    }
    rows.clear();
    for (const Rooms& list : lists) rows.push_back(slots_of(list, rng));
    if (std::all_of(rows.begin(), rows.end(), kitchen_is_well_placed)) break;
  }
  return rows;
}

Rooms without(Rooms rooms, RoomType type) {
  rooms.erase(std::find(rooms.begin(), rooms.end(), type));
  return rooms;
}

/// Corridor in the middle, a row of rooms on either side; `hall` cuts an entrance hall into the second row.
LayoutDraft spine(const Rooms& rooms, bool hall, Rng& rng) {
  std::vector<RoomRow> rows = share_out(rooms, {9.f, hall ? 7.5f : 9.f}, rng);
  if (hall) {
    const auto at = 1 + rng.below(static_cast<std::uint32_t>(std::max<std::size_t>(rows[1].size(), 2) - 1));
    rows[1].insert(rows[1].begin() + std::min<std::ptrdiff_t>(at, std::ssize(rows[1])), {RoomType::kHall});
  }
  const float width = snap(0.5f * (wanted_width(rows[0]) + wanted_width(rows[1])) * range(rng, 0.95f, 1.1f));
  const float north = snap(range(rng, 3.3f, 4.4f));
  const float corridor = snap(range(rng, 1.2f, 1.6f));
  const float south = snap(range(rng, 3.3f, 4.4f));
  LayoutDraft draft;
  draft.add(RoomType::kCorridor, {0, north, width, north + corridor});
  add_row(draft, rows[0], {0, 0, width, north}, false, rng);
  add_row(draft, rows[1], {0, north + corridor, width, north + corridor + south}, true, rng);
  const std::string a = std::min(text(rows[0]) + "|" + text(rows[1]), text(rows[0], true) + "|" + text(rows[1], true));
  const std::string b = std::min(text(rows[1]) + "|" + text(rows[0]), text(rows[1], true) + "|" + text(rows[0], true));
  draft.signature = (hall ? "tee:" : "spine:") + std::min(a, b);
  return draft;
}

/// Living room across one end, corridor with two rows behind it.
LayoutDraft end_room(const Rooms& rooms, Rng& rng) {
  const std::vector<RoomRow> rows = share_out(without(rooms, RoomType::kLiving), {6.f, 6.f}, rng);
  const float living = snap(range(rng, 3.6f, 4.8f));
  const float width = snap(0.5f * (wanted_width(rows[0]) + wanted_width(rows[1])) * range(rng, 1.f, 1.1f));
  const float north = snap(range(rng, 3.f, 3.9f));
  const float corridor = snap(range(rng, 1.2f, 1.6f));
  const float south = snap(range(rng, 3.f, 3.9f));
  LayoutDraft draft;
  draft.add(RoomType::kLiving, {-living, 0, 0, north + corridor + south});
  draft.add(RoomType::kCorridor, {0, north, width, north + corridor});
  add_row(draft, rows[0], {0, 0, width, north}, false, rng);
  add_row(draft, rows[1], {0, north + corridor, width, north + corridor + south}, true, rng);
  draft.signature = "end:" + std::min(text(rows[0]) + "|" + text(rows[1]), text(rows[1]) + "|" + text(rows[0]));
  return draft;
}

/// A row of rooms stacked along z instead of x.
void add_column(LayoutDraft& draft, const RoomRow& row, Rect band, Rng& rng) {
  LayoutDraft turned;
  add_row(turned, row, {band.z0, band.x0, band.z1, band.x1}, true, rng);
  for (const PlanRoom& room : turned.rooms)
    draft.add(room.type, {room.cell.z0, room.cell.x0, room.cell.z1, room.cell.x1});
}

/// Corridor with a bend: a long row above, a short row in the elbow, a column beyond.
LayoutDraft elbow(const Rooms& rooms, Rng& rng) {
  const std::vector<RoomRow> rows = share_out(rooms, {9.f, 4.5f, 4.5f}, rng);
  const float inner = snap(std::max(wanted_width(rows[1]), 3.2f) * range(rng, 1.f, 1.1f));
  const float column = snap(range(rng, 3.2f, 4.2f));
  const float corridor = snap(range(rng, 1.2f, 1.5f));
  const float north = snap(range(rng, 3.2f, 4.2f));
  const float south = snap(std::max(wanted_width(rows[2]) - corridor, 3.4f));
  const float bend = inner + corridor;
  const float total = north + corridor + south;
  LayoutDraft draft;
  draft.add(RoomType::kCorridor, {0, north, bend, north + corridor});
  draft.add(RoomType::kCorridor, {inner, north + corridor, bend, total});
  add_row(draft, rows[0], {0, 0, bend + column, north}, false, rng);
  add_row(draft, rows[1], {0, north + corridor, inner, total}, true, rng);
  add_column(draft, rows[2], {bend, north, bend + column, total}, rng);
  draft.signature = "elbow:" + text(rows[0]) + "|" + text(rows[1]) + "|" + text(rows[2]);
  return draft;
}

std::string least_rotation(const std::vector<RoomRow>& rows, bool reversed) {
  std::string best;
  for (std::size_t start = 0; start < rows.size(); ++start) {
    std::string turn;
    for (std::size_t i = 0; i < rows.size(); ++i) {
      const std::size_t at = reversed ? (start + rows.size() - i) % rows.size() : (start + i) % rows.size();
      turn += text(rows[at], reversed) + "|";
    }
    if (best.empty() || turn < best) best = turn;
  }
  return best;
}

/// Hall in the middle of a pinwheel of four rows, each beginning where the one before it ends.
LayoutDraft wheel(const Rooms& rooms, Rng& rng) {
  const std::vector<RoomRow> rows = share_out(rooms, {4.6f, 4.6f, 4.6f, 4.6f}, rng);
  const float hall_x = snap(range(rng, 2.2f, 3.2f));
  const float hall_z = snap(range(rng, 2.0f, 2.8f));
  const float a = snap(range(rng, 2.9f, 3.7f)), b = snap(range(rng, 2.9f, 3.7f));
  const float c = snap(range(rng, 2.9f, 3.7f)), d = snap(range(rng, 2.9f, 3.7f));
  LayoutDraft draft;
  draft.add(RoomType::kHall, {d, a, d + hall_x, a + hall_z});
  add_row(draft, rows[0], {0, 0, d + hall_x, a}, false, rng);
  add_column(draft, rows[1], {d + hall_x, 0, d + hall_x + b, a + hall_z}, rng);
  add_row(draft, rows[2], {d, a + hall_z, d + hall_x + b, a + hall_z + c}, true, rng);
  add_column(draft, rows[3], {0, a, d, a + hall_z + c}, rng);
  draft.signature = "wheel:" + std::min(least_rotation(rows, false), least_rotation(rows, true));
  return draft;
}

/// Corridor along the outer wall, one row of rooms.
LayoutDraft gallery(const Rooms& rooms, Rng& rng) {
  const std::vector<RoomRow> rows = share_out(rooms, {14.f}, rng);
  const float width = snap(wanted_width(rows[0]) * range(rng, 0.92f, 1.02f));
  const float north = snap(range(rng, 3.9f, 4.8f));
  const float corridor = snap(range(rng, 1.4f, 1.8f));
  LayoutDraft draft;
  draft.add(RoomType::kCorridor, {0, north, width, north + corridor});
  add_row(draft, rows[0], {0, 0, width, north}, false, rng);
  draft.signature = "gallery:" + std::min(text(rows[0]), text(rows[0], true));
  return draft;
}

LayoutDraft make_draft(Rng& rng) {
  const Rooms rooms = make_program(rng);
  switch (rng.below(6)) {
    case 0: return spine(rooms, false, rng);
    case 1: return spine(rooms, true, rng);
    case 2: return end_room(rooms, rng);
    case 3: return elbow(rooms, rng);
    case 4: return wheel(rooms, rng);
    default: return rooms.size() <= 5 ? gallery(rooms, rng) : spine(rooms, rng.chance(0.5), rng);
  }
}

bool is_usable(const LayoutDraft& draft) {
  float area = 0.f;
  for (const PlanRoom& room : draft.rooms) {
    const Sizes sizes = sizes_of(room.type);
    const Rect inside = room.inside();
    if (std::min(inside.width(), inside.depth()) < sizes.min_side || inside.area() < sizes.min_area) return false;
    if (!is_passage(room.type) && std::max(inside.width(), inside.depth()) > 9.f) return false;
    if (is_wet(room.type) && inside.area() > 11.f) return false;
    area += inside.area();
  }
  const std::size_t rooms = draft.rooms.size();
  return rooms >= 5 && rooms <= 9 && area >= 60.f && area <= 130.f;
}

/// Whether doors can join all rooms without leading through a bathroom or laundry.
bool is_connectable(const LayoutDraft& draft) {
  std::vector<bool> reached(draft.rooms.size(), false);
  std::vector<std::size_t> open{0};
  reached[0] = true;
  while (!open.empty()) {
    const PlanRoom& room = draft.rooms[open.back()];
    open.pop_back();
    if (is_wet(room.type)) continue;
    for (std::size_t i = 0; i < reached.size(); ++i) {
      if (reached[i] || shared_wall(room.cell, draft.rooms[i].cell).length() < kDoorWall) continue;
      reached[i] = true;
      open.push_back(i);
    }
  }
  return std::all_of(reached.begin(), reached.end(), [](bool value) { return value; });
}

/// A signature's owner: half of them train, a quarter each val and test.
Split owner(const std::string& signature) {
  std::uint64_t key = 0x5EED;
  for (const char c : signature) key = stream_key({key, static_cast<std::uint64_t>(c)});
  const std::array<Split, 4> kOwners{Split::kTrain, Split::kTrain, Split::kVal, Split::kTest};
  return kOwners[key & 3u];
}

void name_rooms(std::vector<PlanRoom>& rooms) {
  std::map<RoomType, int> total, seen;
  for (const PlanRoom& room : rooms) ++total[room.type];
  for (PlanRoom& room : rooms) {
    room.name = room_name(room.type);
    if (total[room.type] > 1) room.name.append(" ").append(std::to_string(++seen[room.type]));
  }
}

/// Random mirror image, centred on the origin.
void place(std::vector<PlanRoom>& rooms, Rng& rng) {
  const bool mirror_x = rng.chance(0.5), mirror_z = rng.chance(0.5), turn = rng.chance(0.5);
  Rect all = rooms.front().cell;
  for (PlanRoom& room : rooms) {
    Rect& c = room.cell;
    if (mirror_x) c = {-c.x1, c.z0, -c.x0, c.z1};
    if (mirror_z) c = {c.x0, -c.z1, c.x1, -c.z0};
    if (turn) c = {c.z0, c.x0, c.z1, c.x1};
  }
  all = rooms.front().cell;
  for (const PlanRoom& room : rooms) {
    all = {std::min(all.x0, room.cell.x0), std::min(all.z0, room.cell.z0), std::max(all.x1, room.cell.x1),
           std::max(all.z1, room.cell.z1)};
  }
  const float dx = -snap(0.5f * (all.x0 + all.x1)), dz = -snap(0.5f * (all.z0 + all.z1));
  for (PlanRoom& room : rooms) room.cell = {room.cell.x0 + dx, room.cell.z0 + dz, room.cell.x1 + dx, room.cell.z1 + dz};
}

}  // namespace

FloorPlan make_layout(std::uint64_t seed, Split split) {
  for (std::uint64_t attempt = 0;; ++attempt) {
    Rng rng = stream(seed, Stream::kLayout, static_cast<std::uint64_t>(split), attempt);
    LayoutDraft draft = make_draft(rng);
    if (!is_usable(draft) || !is_connectable(draft) || owner(draft.signature) != split) continue;
    place(draft.rooms, rng);
    name_rooms(draft.rooms);
    FloorPlan plan;
    plan.rooms = std::move(draft.rooms);
    plan.signature = std::move(draft.signature);
    plan.ceiling = snap(range(rng, 2.5f, 2.85f));
    return plan;
  }
}

SharedWall shared_wall(const Rect& a, const Rect& b) {
  constexpr float kTouch = 0.01f;
  const auto along_x = std::pair{std::max(a.x0, b.x0), std::min(a.x1, b.x1)};
  const auto along_z = std::pair{std::max(a.z0, b.z0), std::min(a.z1, b.z1)};
  if (std::abs(a.x0 - b.x1) < kTouch) return {Side::kWest, a.x0, along_z.first, along_z.second};
  if (std::abs(a.x1 - b.x0) < kTouch) return {Side::kEast, a.x1, along_z.first, along_z.second};
  if (std::abs(a.z0 - b.z1) < kTouch) return {Side::kNorth, a.z0, along_x.first, along_x.second};
  if (std::abs(a.z1 - b.z0) < kTouch) return {Side::kSouth, a.z1, along_x.first, along_x.second};
  return {};
}

float FloorPlan::area() const {
  return std::accumulate(rooms.begin(), rooms.end(), 0.f,
                         [](float sum, const PlanRoom& room) { return sum + room.inside().area(); });
}

int FloorPlan::loops() const {
  const auto edges = std::count_if(openings.begin(), openings.end(), [](const Opening& o) { return o.passable(); });
  return static_cast<int>(edges) - static_cast<int>(rooms.size()) + 1;  // the graph is connected
}

}  // namespace wiw::apartment
