// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <map>
#include <span>
#include <string>
#include <vector>

#include "wiw/apartment/materials.hpp"
#include "wiw/apartment/palette.hpp"
#include "wiw/apartment/random.hpp"
#include "wiw/apartment/room_type.hpp"
#include "wiw/core/rng.hpp"

namespace wiw::apartment {

/// Flat place for small objects, in the furniture's frame, with the free height above it.
struct Support {
  Vec3 center;
  Vec2 half;  // x, z
  float clearance = 0.5f;
};

/// Light a lamp gives, in its own frame.
struct Bulb {
  Vec3 position;
  float strength = 1.f;  // of a room's main lamp
};

/// Inputs of a furniture function, and the shape and attributes that it fills in. Frame: see Shape; back at z = -size.z
/// / 2.
struct FurnitureBuilder {
  Vec3 size;  // width, height, depth
  Rng& rng;
  MaterialTable& materials;
  const RoomLook& look;
  bool on = false;      // lamps and screens
  std::string state{};  // that an edit asks for, one of states_of(); empty: the design's own
  FurnitureShape shape{};
  std::vector<Support> supports;
  std::vector<Bulb> bulbs;
  std::map<std::string, std::string> attributes;
  bool casts_shadow = true;
  Rgb main_color = Rgb::Ones();               // last one described
  std::vector<Eigen::AlignedBox3f> leaves{};  // open doors that stand out of the body

  [[nodiscard]] float w() const { return size.x(); }
  [[nodiscard]] float h() const { return size.y(); }
  [[nodiscard]] float d() const { return size.z(); }
  MaterialId wood(const Rgb& color) { return materials.tinted(Pattern::kGrain, color); }
  MaterialId fabric(const Rgb& color) { return materials.tinted(Pattern::kWeave, color); }
  MaterialId plain(const std::string& kind, const Rgb& color) { return materials.plain(kind, color); }
  MaterialId chrome() { return materials.plain("metal", {0.78f, 0.79f, 0.8f}); }
  MaterialId white() { return materials.plain("ceramic", {0.94f, 0.94f, 0.93f}); }
  MaterialId black() { return materials.plain("plastic", {0.1f, 0.1f, 0.11f}); }
  /// Colour of case furniture: mostly the room's wood, sometimes paint; sets the attributes.
  Rgb case_color();
  /// One of the room's fabrics; sets the attributes.
  Rgb fabric_color();
  /// Sets the attribute: "open" or "closed", by the design's own chance where no edit says which.
  bool draw_open(double chance);
  MaterialId case_material(const Rgb& color);
  void describe(const Rgb& main, const std::string& kind) {
    main_color = main;
    attributes["color"] = color_name(main);
    attributes["material"] = kind;
  }
};
using FurnitureFn = void (*)(FurnitureBuilder&);

enum class Mount {
  kWall,     // on the floor, back to a wall
  kCorner,   // on the floor, in a corner if it can
  kCentre,   // on the floor, away from walls
  kHung,     // on a wall, `height` above the floor
  kCeiling,  // under the ceiling
  kTop,      // on another object
  kAttached  // only with the furniture that names it as a companion
};

struct Prior {
  RoomType room;
  double chance;
  int most = 1;
};

enum class Slot {
  kBeside,    // left and right, backs in line
  kAround,    // on all sides, facing in
  kBefore,    // in front, facing back
  kAhead,     // in front with a gap for legs, same way round
  kUnder,     // flat under it, larger than it
  kFoot,      // across its front end
  kOpposite,  // at a wall it faces
  kAbove,     // on the wall over it
  kOnTop      // on it, in the middle
};

struct Companion {
  const char* category;
  Slot slot;
  double chance;
  int most = 1;
};

/// One kind of furniture: a function and a row of the catalogue.
struct Category {
  const char* name;
  FurnitureFn make;
  Vec3 smallest, largest;  // width, height, depth
  Mount mount;
  float front = 0.f;   // free floor it needs in front
  float height = 0.f;  // of its lower edge, where hung
  std::vector<Prior> priors;
  std::vector<Companion> companions;
};

/// All categories; those placed first come first.
std::span<const Category> catalogue();
/// Index by name; throws ArgumentError for an unknown one.
std::size_t category_index(const std::string& name);
/// States that a category can be built in; empty for one that has but one.
const std::vector<std::string>& states_of(const std::string& category);
/// Whether people move such things about: not what is fixed to walls, pipes or the ceiling.
bool is_movable(const std::string& category);

}  // namespace wiw::apartment
