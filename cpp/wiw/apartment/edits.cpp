// SPDX-License-Identifier: Apache-2.0
#include "wiw/apartment/edits.hpp"

#include <algorithm>
#include <cmath>
#include <functional>
#include <set>

#include "wiw/apartment/furniture/furniture.hpp"
#include "wiw/apartment/placement.hpp"
#include "wiw/apartment/random.hpp"
#include "wiw/core/error.hpp"

namespace wiw::apartment {

namespace {

using WorldBox = Eigen::AlignedBox3f;

constexpr float kHead = 1.5f;     // what hangs higher is in nobody's way
constexpr float kCounter = 1.2f;  // furniture to put things on is lower
constexpr float kTouch = 0.01f;   // by which boxes may overlap
constexpr float kSheer = 0.35f;   // share of daylight that a closed curtain lets through

[[noreturn]] void refuse(const Edit& edit, const std::string& why) {
  throw ArgumentError("edit '" + to_text(edit) + "': " + why);
}

std::string listed(const std::vector<std::string>& words) {
  std::string text;
  for (std::size_t i = 0; i < words.size(); ++i)
    text += (i == 0 ? "'" : i + 1 == words.size() ? " or '" : ", '") + words[i] + "'";
  return text;
}

/// Least number of letters to change, add or drop.
std::size_t spelling_distance(const std::string& a, const std::string& b) {
  std::vector<std::size_t> row(b.size() + 1);
  for (std::size_t j = 0; j <= b.size(); ++j) row[j] = j;
  for (std::size_t i = 1; i <= a.size(); ++i) {
    std::size_t diagonal = row[0];
    row[0] = i;
    for (std::size_t j = 1; j <= b.size(); ++j) {
      const std::size_t change = diagonal + (a[i - 1] == b[j - 1] ? 0 : 1);
      diagonal = row[j];
      row[j] = std::min({change, row[j] + 1, row[j - 1] + 1});
    }
  }
  return row[b.size()];
}

std::string did_you_mean(const std::string& word, std::vector<std::string> known) {
  const auto distance = [&](const std::string& other) { return spelling_distance(word, other); };
  std::stable_sort(known.begin(), known.end(), [&](const auto& a, const auto& b) { return distance(a) < distance(b); });
  const std::size_t near = std::max<std::size_t>(2, word.size() / 3);
  std::erase_if(known, [&](const std::string& other) { return distance(other) > near; });
  known.resize(std::min<std::size_t>(known.size(), 3));
  return known.empty() ? "" : "; did you mean " + listed(known) + "?";
}

/// Names by which edits call the objects: their own, with ".1", ".2" where several have the same.
std::vector<std::string> labels_of(const std::vector<Object>& objects) {
  std::map<std::string, int> total, count;
  for (const Object& object : objects) ++total[object.name];
  std::vector<std::string> labels;
  for (const Object& object : objects) {
    const bool shared = total[object.name] > 1;
    labels.push_back(shared ? object.name + "." + std::to_string(++count[object.name]) : object.name);
  }
  return labels;
}

std::uint64_t text_key(const std::string& text) {
  std::uint64_t key = kRootKey;
  for (const char letter : text) key = mix_key(key, static_cast<unsigned char>(letter));
  return key;
}

/// The design of a piece of furniture. Walls, doors and the like have none, and are asked for none.
const Design& design_of(const Object& object) {
  if (!object.design) throw std::logic_error(object.name + " has no design");
  return *object.design;
}

enum class Stand { kFloor, kTop, kHung, kFixed };

Stand stand_of(const Object& object) {
  if (!object.design || !is_movable(object.category) || object.category == "rug" || object.category == "curtain")
    return Stand::kFixed;
  if (object.support != scene::kNone) return Stand::kTop;
  if (catalogue()[object.design->category].mount == Mount::kHung) return Stand::kHung;
  return object.pose.translation().y() < 0.005f ? Stand::kFloor : Stand::kFixed;
}

/// Place of `a` where `b` is: backs in line at walls, middles on tables; pictures hang by their middles.
Eigen::Affine3f pose_in_place_of(const Object& a, const Object& b) {
  const Stand stand = stand_of(a);
  const Vec3 more = design_of(a).size - design_of(b).size;
  const float forward = stand == Stand::kTop ? 0.f : 0.5f * more.z();
  const float down = stand == Stand::kHung ? 0.5f * more.y() : 0.f;
  return b.pose * Eigen::Translation3f(0.f, -down, forward);
}

/// Colours that go with an object's main colour, as functions of it.
const std::vector<std::function<Rgb(const Rgb&)>>& shades() {
  static const std::vector<std::function<Rgb(const Rgb&)>> kShades{
      [](const Rgb& color) { return color; }, [](const Rgb& color) { return Rgb(0.85f * color); },  // lids of boxes
      [](const Rgb& color) { return lit_shade(color); }};
  return kShades;
}

bool has_color_of_its_own(const Object& object) {
  static const std::set<std::string> kOthers{"ceiling lamp", "mirror",    "passage", "photo",      "picture",
                                             "plant",        "plant pot", "shower",  "television", "window"};
  return !kOthers.contains(object.category);
}

class Editor {
 public:
  explicit Editor(Draft& draft) : draft_(draft), labels_(labels_of(draft.objects)), gone_(draft.objects.size(), false) {
    for (const Object& object : draft.objects) boxes_.push_back(box_of(object, object.pose));
  }

  void apply(const std::vector<Edit>& edits) {
    for (const EditKind kind : {EditKind::kRemove, EditKind::kSwap, EditKind::kState, EditKind::kColor}) {
      std::vector<Edit> same;
      std::copy_if(edits.begin(), edits.end(), std::back_inserter(same), [&](const Edit& e) { return e.kind == kind; });
      // All removals are known before the first, so that a table may go with what stands on it.
      if (kind == EditKind::kRemove) {
        for (const Edit& edit : same) gone_[find(edit, edit.name)] = true;
      }
      for (const Edit& edit : same) apply(edit);
    }
    for (const Edit& edit : edits) draft_.edits.push_back(to_text(edit));
    drop_the_gone();
  }

  std::vector<Edit> possible() {
    std::vector<Edit> edits;
    const auto offer = [&](const Edit& edit) {
      if (obstacle(edit).empty()) edits.push_back(edit);
    };
    for (std::size_t i = 0; i < labels_.size(); ++i) {
      for (const std::string& color : color_names()) offer({EditKind::kColor, labels_[i], color});
      offer({EditKind::kRemove, labels_[i], ""});
      for (const std::string& state : states_of(object(i).category)) offer({EditKind::kState, labels_[i], state});
      for (std::size_t j = 0; j < labels_.size(); ++j) {
        if (labels_[i] < labels_[j]) offer({EditKind::kSwap, labels_[i], labels_[j]});
      }
    }
    return edits;
  }

 private:
  Object& object(std::size_t index) { return draft_.objects[index]; }

  static WorldBox box_of(const Object& object, const Eigen::Affine3f& pose) {
    WorldBox box = object.shape.bounds();
    return box.isEmpty() ? box : box.transformed(pose);
  }

  std::size_t find(const Edit& edit, const std::string& name) const {
    const auto found = std::find(labels_.begin(), labels_.end(), name);
    if (found != labels_.end()) return static_cast<std::size_t>(found - labels_.begin());
    std::vector<std::string> alike;
    for (const std::string& label : labels_) {
      if (label.substr(0, label.rfind('.')) == name) alike.push_back(label);
    }
    if (!alike.empty()) refuse(edit, "there are several; expected " + listed(alike));
    refuse(edit, "apartment " + split_name(draft_.split) + "/" + std::to_string(draft_.seed) + " has no '" + name +
                     "'" + did_you_mean(name, labels_));
  }

  void apply(const Edit& edit) {
    const std::size_t index = find(edit, edit.name);
    const std::string why = obstacle(edit);
    if (!why.empty()) refuse(edit, why);
    switch (edit.kind) {
      case EditKind::kColor: return paint(index, edit.value);
      case EditKind::kState: return set_state(index, edit.value);
      case EditKind::kSwap: return swap(index, find(edit, edit.value));
      case EditKind::kRemove: return;  // by drop_the_gone
    }
  }

  /// Why an edit cannot be, with what is possible instead; empty if it can.
  std::string obstacle(const Edit& edit) {
    const std::size_t index = find(edit, edit.name);
    switch (edit.kind) {
      case EditKind::kColor: return color_obstacle(object(index), edit.value);
      case EditKind::kState: return state_obstacle(index, edit.value);
      case EditKind::kRemove: return removal_obstacle(index);
      case EditKind::kSwap: return swap_obstacle(index, find(edit, edit.value));
    }
    return {};
  }

  // --- colours

  template <class Submeshes>
  bool shows_color(const Object& object, Submeshes&& parts) const {
    return std::any_of(parts.begin(), parts.end(), [&](const Submesh& part) {
      const bool tinted = std::find(part.tint.begin(), part.tint.end(), object.color) != part.tint.end();
      return tinted || std::any_of(shades().begin(), shades().end(), [&](const auto& shade) {
               return draft_.materials.shows(part.material, shade(object.color));
             });
    });
  }

  std::string color_obstacle(const Object& object, const std::string& color) const {
    if (!has_color_of_its_own(object) || !shows_main_color(object))
      return "a " + object.category + " has no colour of its own that could be another";
    std::vector<std::string> others = color_names();
    std::erase(others, color_name(object.color));
    if (std::find(others.begin(), others.end(), color) != others.end()) return {};
    if (color == color_name(object.color)) return "it is " + color + " already; expected " + listed(others);
    return "expected one of " + listed(others) + did_you_mean(color, others);
  }

  bool shows_main_color(const Object& object) const {
    return shows_color(object, object.shape.parts()) ||
           std::any_of(object.panels.begin(), object.panels.end(), [&](const Panel& panel) {
             return shows_color(object, std::array<std::reference_wrapper<const Submesh>, 1>{panel.part});
           });
  }

  void paint(std::size_t index, const std::string& name) {
    Object& changed = object(index);
    Rng rng(stream_key({draft_.seed, text_key(labels_[index]), text_key(name)}));
    const Rgb from = changed.color, to = draw_color(name, draft_.split, rng);
    for (Panel& panel : changed.panels) paint_part(panel.part, from, to);
    for (Submesh& part : changed.shape.parts()) paint_part(part, from, to);
    changed.color = to;
    changed.attributes["color"] = name;
  }

  void paint_part(Submesh& part, const Rgb& from, const Rgb& to) {
    if (from != Rgb::Ones()) std::replace(part.tint.begin(), part.tint.end(), from, to);
    for (const auto& shade : shades()) {
      if (!draft_.materials.shows(part.material, shade(from))) continue;
      part.material = draft_.materials.repaint(part.material, shade(from), shade(to));
      return;
    }
  }

  // --- states

  std::string state_obstacle(std::size_t index, const std::string& state) {
    const Object& changed = object(index);
    const std::vector<std::string>& all = states_of(changed.category);
    if (all.empty()) return "a " + changed.category + " has no states to choose from";
    std::vector<std::string> others = all;
    std::erase(others, changed.attributes.at("state"));
    if (state == changed.attributes.at("state")) return "it is " + state + " already; expected " + listed(others);
    if (std::find(others.begin(), others.end(), state) == others.end())
      return "expected " + listed(others) + did_you_mean(state, others);
    MaterialTable scratch = draft_.materials;
    const BuiltPiece built = build_piece(design_of(changed), state, scratch, draft_.palette);
    for (const WorldBox& leaf : built.object.leaves) {
      const std::string hit = leaf_obstacle(index, leaf.transformed(changed.pose));
      if (!hit.empty()) return "its door " + hit;
    }
    return {};
  }

  /// What an open door would hit; empty if it has room and people can still pass.
  std::string leaf_obstacle(std::size_t owner, const WorldBox& leaf) {
    const std::int32_t room = object(owner).room;
    const WorldBox core(leaf.min() + Vec3::Constant(kTouch), leaf.max() - Vec3::Constant(kTouch));
    for (std::size_t i = 0; i < boxes_.size(); ++i) {
      if (i == owner || !is_solid(i) || object(i).room != room) continue;
      if (core.intersects(boxes_[i])) return "would hit '" + labels_[i] + "'";
    }
    const Rect area{core.min().x(), core.min().z(), core.max().x(), core.max().z()};
    RoomFloor floor(draft_.plan, room);
    stand_all(floor, room, {});
    const Rect own = is_on_floor(owner) ? area_under(object(owner), object(owner).pose) : kNowhere;
    if (!floor.inside().contains(area)) return "would hit a wall";
    if (core.min().y() > kHead) return {};
    const bool low = core.min().y() < kCounter;  // a higher one reaches over what stands below
    if (low && !floor.fits_with(area, own)) return "would be in the way";
    floor.stand(area, {});
    return floor.is_walkable() ? "" : "would be in the way";
  }

  void set_state(std::size_t index, const std::string& state) {
    Object& changed = object(index);
    BuiltPiece built = build_piece(design_of(changed), state, draft_.materials, draft_.palette);
    changed.attributes = built.object.attributes;
    changed.shape = std::move(built.object.shape);
    changed.leaves = std::move(built.object.leaves);
    boxes_[index] = box_of(changed, changed.pose);
    std::erase_if(draft_.lights, [&](const Light& light) { return light.source == index; });
    const LampLight& lamps = draft_.lamp_light[static_cast<std::size_t>(changed.room)];
    for (const Bulb& bulb : built.bulbs) {
      // One ceiling lamp or more share what the room's lamps give; a lamp switched on adds its part of that.
      const float part = bulb.strength / std::max(1.f, lamps.strength + bulb.strength);
      draft_.lights.push_back({changed.pose * bulb.position, Vec3::Zero(), Vec3::Zero(), Vec3::Zero(),
                               part * lamps.share * lamp_color(), changed.room, index});
    }
    if (changed.category == "curtain" && state == "closed") dim_window(changed);
  }

  /// Daylight behind a closed curtain: the cloth shines in the window's stead.
  void dim_window(const Object& curtain) {
    const Vec3 into = curtain.pose.linear() * Vec3::UnitZ();
    for (Light& light : draft_.lights) {
      const Vec3 off = light.center - curtain.pose.translation();
      const bool behind = light.one_sided() && light.room == curtain.room && light.axis.dot(into) > 0.99f &&
                          std::abs(off.dot(into)) < 0.4f && std::abs(off.dot(light.u.normalized())) < 0.3f;
      if (!behind) continue;
      light.center += (0.07f - off.dot(into)) * into;
      light.strength *= kSheer;
    }
  }

  // --- removals

  std::string removal_obstacle(std::size_t index) {
    if (!object(index).design || !is_movable(object(index).category))
      return "a " + object(index).category + " is part of the building; expected furniture that can be moved";
    std::vector<std::string> on_it;
    for (std::size_t i = 0; i < labels_.size(); ++i) {
      if (!gone_[i] && object(i).support == static_cast<std::int32_t>(index)) on_it.push_back(labels_[i]);
    }
    if (on_it.empty()) return {};
    return "something stands on it; remove " + listed(on_it) + " as well, by edits of their own";
  }

  void drop_the_gone() {
    std::vector<std::int32_t> place(gone_.size(), scene::kNone);
    std::int32_t next = 0;
    for (std::size_t i = 0; i < gone_.size(); ++i) {
      if (!gone_[i]) place[i] = next++;
    }
    std::erase_if(draft_.lights, [&](const Light& light) { return gone_[light.source]; });
    for (Light& light : draft_.lights) light.source = static_cast<std::size_t>(place[light.source]);
    std::vector<Object> left;
    for (std::size_t i = 0; i < gone_.size(); ++i) {
      if (gone_[i]) continue;
      if (object(i).support != scene::kNone) object(i).support = place[static_cast<std::size_t>(object(i).support)];
      left.push_back(std::move(object(i)));
    }
    draft_.objects = std::move(left);
  }

  // --- swaps

  std::string swap_obstacle(std::size_t a, std::size_t b) {
    const Object &first = object(a), &second = object(b);
    const Stand stand = stand_of(first);
    if (stand == Stand::kFixed || stand_of(second) != stand)
      return "expected two movable things that both stand on the floor, stand on furniture or hang on walls";
    const Vec3 unlike = (design_of(first).size - design_of(second).size).cwiseAbs();
    const float across = stand == Stand::kHung ? std::max(unlike.x(), unlike.y()) : std::max(unlike.x(), unlike.z());
    const float most = stand == Stand::kTop ? 0.08f : stand == Stand::kHung ? 0.2f : 0.15f;
    if (across > most) return "expected two things of one size; these differ by more than " + centimetres(most);
    if (first.category == second.category && looks(first) == looks(second)) return "the two look the same";
    if (group_box(a, pose_in_place_of(first, second)).intersects(group_box(b, pose_in_place_of(second, first))))
      return "they stand too close together";
    for (const auto& [goes, stays] : {std::pair{a, b}, std::pair{b, a}}) {
      const std::string why = place_obstacle(goes, stays);
      if (!why.empty()) return "'" + labels_[goes] + "' has no room where '" + labels_[stays] + "' is: " + why;
    }
    return {};
  }

  static std::string centimetres(float metres) { return std::to_string(std::lround(100.f * metres)) + " cm"; }

  static std::array<std::string, 3> looks(const Object& object) {
    const auto value = [&](const char* key) {
      const auto found = object.attributes.find(key);
      return found == object.attributes.end() ? std::string() : found->second;
    };
    return {value("color"), value("material"), value("state")};
  }

  /// Whether the object is the other one or stands on it, directly or not.
  bool belongs_to(std::size_t index, std::size_t owner) {
    for (auto at = static_cast<std::int32_t>(index); at != scene::kNone;
         at = object(static_cast<std::size_t>(at)).support) {
      if (static_cast<std::size_t>(at) == owner) return true;
    }
    return false;
  }

  bool is_solid(std::size_t index) {
    static const std::set<std::string> kOpen{"ceiling", "door frame", "floor", "passage", "rug", "wall", "window"};
    return !gone_[index] && !boxes_[index].isEmpty() && !kOpen.contains(object(index).category);
  }

  bool is_on_floor(std::size_t index) {
    const Object& piece = object(index);
    return !gone_[index] && piece.design && piece.support == scene::kNone && piece.category != "rug" &&
           piece.pose.translation().y() < 0.005f;
  }

  static Rect area_under(const Object& piece, const Eigen::Affine3f& pose) {
    const Vec3 front = pose.linear() * Vec3::UnitZ();
    const Design& design = design_of(piece);
    PlacedPiece placed{design.category, piece.room, design.size, pose.translation(), std::atan2(front.x(), front.z())};
    return footprint(placed);
  }

  /// Puts all furniture of a room on an empty floor except `without`.
  void stand_all(RoomFloor& floor, std::int32_t room, const std::vector<std::size_t>& without) {
    for (std::size_t i = 0; i < labels_.size(); ++i) {
      const bool skipped = std::find(without.begin(), without.end(), i) != without.end();
      if (!skipped && is_on_floor(i) && object(i).room == room) floor.stand(area_under(object(i), object(i).pose), {});
    }
  }

  /// Everything that moves with an object, as one box.
  WorldBox group_box(std::size_t index, const Eigen::Affine3f& pose) {
    WorldBox box;
    for (std::size_t i = 0; i < labels_.size(); ++i) {
      if (gone_[i] || !belongs_to(i, index)) continue;
      const Eigen::Affine3f moved = pose * object(index).pose.inverse() * object(i).pose;
      box.extend(box_of(object(i), moved));
    }
    return box;
  }

  std::string place_obstacle(std::size_t goes, std::size_t stays) {
    const Object &piece = object(goes), &other = object(stays);
    const Eigen::Affine3f pose = pose_in_place_of(piece, other);
    WorldBox box = group_box(goes, pose);
    if (stand_of(piece) == Stand::kTop && box.sizes().y() > other.headroom) return "it is too high";
    box = WorldBox(box.min() + Vec3::Constant(kTouch), box.max() - Vec3::Constant(kTouch));
    const WorldBox before = group_box(stays, other.pose);
    for (std::size_t i = 0; i < boxes_.size(); ++i) {
      if (!is_solid(i) || object(i).room != other.room || belongs_to(i, goes) || belongs_to(i, stays)) continue;
      if (box.intersects(boxes_[i]) && !before.intersects(boxes_[i])) return "'" + labels_[i] + "' is in the way";
    }
    RoomFloor floor(draft_.plan, other.room);
    const Rect area = area_under(piece, pose), old = area_under(other, other.pose);
    if (!floor.inside().contains(area)) return "a wall is in the way";
    if (hides_opening(floor, area, box) && !hides_opening(floor, old, before)) return "a door or window is in the way";
    if (stand_of(piece) != Stand::kFloor) return {};
    stand_all(floor, other.room, {goes, stays});
    // Chairs may reach under tables where a chair did so.
    if (!floor.fits_with(area, kNowhere) && floor.fits_with(old, kNowhere)) return "one could no longer pass";
    floor.stand(area, {});
    if (piece.room == other.room) floor.stand(area_under(other, pose_in_place_of(other, piece)), {});
    return floor.is_walkable() ? "" : "one could no longer pass";
  }

  /// Whether something at a wall stands or hangs before an opening in it.
  static bool hides_opening(const RoomFloor& floor, const Rect& area, const WorldBox& box) {
    const Rect& inside = floor.inside();
    const std::array<std::pair<Side, float>, 4> gaps{{{Side::kWest, area.x0 - inside.x0},
                                                      {Side::kEast, inside.x1 - area.x1},
                                                      {Side::kNorth, area.z0 - inside.z0},
                                                      {Side::kSouth, inside.z1 - area.z1}}};
    return std::any_of(gaps.begin(), gaps.end(), [&](const auto& gap) {
      const bool along_x = runs_along_x(gap.first);
      const WallPatch patch{gap.first, along_x ? area.x0 : area.z0, along_x ? area.x1 : area.z1, box.min().y(),
                            box.max().y()};
      return gap.second < 0.12f && !floor.wall_is_free(patch);
    });
  }

  void swap(std::size_t a, std::size_t b) {
    const Eigen::Affine3f to_b = pose_in_place_of(object(a), object(b)), to_a = pose_in_place_of(object(b), object(a));
    const std::int32_t room_a = object(a).room, room_b = object(b).room;
    const std::vector<std::size_t> with_a = group(a), with_b = group(b);
    move(with_a, to_b * object(a).pose.inverse(), room_b);
    move(with_b, to_a * object(b).pose.inverse(), room_a);
    object(a).pose = to_b, object(b).pose = to_a;
    std::swap(object(a).support, object(b).support);
    std::swap(object(a).headroom, object(b).headroom);
    for (const std::size_t i : {a, b}) boxes_[i] = box_of(object(i), object(i).pose);
  }

  std::vector<std::size_t> group(std::size_t owner) {
    std::vector<std::size_t> members;
    for (std::size_t i = 0; i < labels_.size(); ++i) {
      if (!gone_[i] && belongs_to(i, owner)) members.push_back(i);
    }
    return members;
  }

  void move(const std::vector<std::size_t>& members, const Eigen::Affine3f& by, std::int32_t room) {
    for (const std::size_t i : members) {
      object(i).pose = by * object(i).pose;
      object(i).room = room;
      boxes_[i] = box_of(object(i), object(i).pose);
    }
    for (Light& light : draft_.lights) {
      if (std::find(members.begin(), members.end(), light.source) == members.end()) continue;
      light.center = by * light.center;
      light.room = room;
    }
  }

  Draft& draft_;
  std::vector<std::string> labels_;
  std::vector<bool> gone_;
  std::vector<WorldBox> boxes_;  // of shapes, in the world
};

}  // namespace

void apply_edits(Draft& draft, const std::vector<Edit>& edits) {
  if (!edits.empty()) Editor(draft).apply(edits);
}

std::vector<Edit> possible_edits(const Draft& draft, const std::vector<Edit>& applied) {
  Draft copy = draft;
  std::vector<Edit> edits = Editor(copy).possible();
  std::erase_if(edits, [&](const Edit& edit) {
    return std::any_of(applied.begin(), applied.end(), [&](const Edit& other) { return contradict(edit, other); });
  });
  return edits;
}

}  // namespace wiw::apartment
