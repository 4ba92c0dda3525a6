// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <map>
#include <optional>
#include <string>
#include <vector>

#include "wiw/apartment/floor_plan.hpp"
#include "wiw/apartment/furniture/catalogue.hpp"
#include "wiw/apartment/materials.hpp"
#include "wiw/apartment/palette.hpp"
#include "wiw/apartment/shape.hpp"

namespace wiw::apartment {

struct Edit;

/// Flat rectangle whose light is kept in texels: walls, floors, ceilings.
struct Chart {
  Vec3 origin, u, v;  // corner and unit axes; the lit side is u x v
  Vec2 size;          // metres
  float texel = 0.05f;
  std::vector<Eigen::AlignedBox2f> holes;  // in (u, v); no surface there
};

/// Piece of an object's surface on a chart, in world coordinates.
struct Panel {
  Submesh part;
  std::size_t chart = 0;
};

/// What a piece of furniture was built from, and by which it can be built again in another state.
struct Design {
  std::size_t category = 0;  // of the catalogue
  Vec3 size = Vec3::Ones();
  std::uint64_t key = 0;
  std::int32_t room = kOutside;  // whose palette it has
  bool on = false;
};

/// Everything about one instance but its light.
struct Object {
  std::string name;  // unlike all others', but for doors and windows of one room
  std::string category;
  std::map<std::string, std::string> attributes;
  std::int32_t room = kOutside;
  Eigen::Affine3f pose = Eigen::Affine3f::Identity();
  FurnitureShape shape;  // lit at its vertices
  std::vector<Panel> panels;
  bool casts_shadow = true;
  Rgb color = Rgb::Ones();                    // that the attribute "color" names
  std::optional<Design> design{};             // of furniture
  std::int32_t support = scene::kNone;        // index of the object that it stands on
  float headroom = 0.f;                       // free height above `support`
  std::vector<Eigen::AlignedBox3f> leaves{};  // open doors, in its own frame
};

/// Source of light: a rectangle (half axes `u`, `v`) that shines to the side of `axis`, or a lamp that shines all
/// round.
struct Light {
  Vec3 center, u = Vec3::Zero(), v = Vec3::Zero(), axis = Vec3::Zero();
  Rgb strength = Rgb::Ones();  // radiance of a rectangle times its area; intensity of a lamp; linear
  std::int32_t room = kOutside;
  std::size_t source = 0;  // index of the object that shines
  [[nodiscard]] bool one_sided() const { return !axis.isZero(); }
};

/// How bright the lamps of a room are.
struct LampLight {
  float share = 0.f;     // intensity of all of them together
  float strength = 0.f;  // sum of Bulb::strength of those that were on when the apartment was furnished
};

/// An apartment on its way from plan to scene.
struct Draft {
  std::uint64_t seed = 0;
  Split split = Split::kVal;
  FloorPlan plan;
  Palette palette;
  MaterialTable materials{0};
  std::vector<Object> objects;
  std::vector<Chart> charts;
  std::vector<Light> lights;
  std::vector<LampLight> lamp_light;  // by room
  std::vector<std::string> edits;     // that were applied
};

/// Floors, ceilings, walls, skirting; then frames, door leaves and windows with their daylight.
void build_walls(Draft& draft);
void build_openings(Draft& draft);
/// Furniture, small objects, pictures and lamps.
void furnish(Draft& draft);
/// The object of a design, without its place, and the lamps in it.
struct BuiltPiece {
  Object object;
  std::vector<Bulb> bulbs;
  std::vector<Support> supports;
};
/// `state` is one of states_of(category), or empty for the design's own.
BuiltPiece build_piece(const Design& design, const std::string& state, MaterialTable& materials,
                       const Palette& palette);
/// Colour of lamps' light.
Rgb lamp_color();
/// Gives each room its share of light for its size.
void balance_lights(Draft& draft);
/// Plans, furnishes and lights an apartment, then edits it.
Draft make_draft(std::uint64_t seed, Split split, const std::vector<Edit>& edits);
/// How many packets of 16 rays look for bounced light. A texel's are few, since a 4 x 4 block of texels is smoothed.
struct BounceRays {
  std::size_t texel_packets = 1, vertex_packets = 2;
};
/// The finished scene with baked light.
scene::Scene bake(const Draft& draft, ThreadPool& pool, const BounceRays& rays = {});
/// The same instances without light and textures.
scene::Scene outline(const Draft& draft);

}  // namespace wiw::apartment
