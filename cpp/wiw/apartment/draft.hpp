// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <map>
#include <string>
#include <vector>

#include "wiw/apartment/floor_plan.hpp"
#include "wiw/apartment/materials.hpp"
#include "wiw/apartment/palette.hpp"
#include "wiw/apartment/shape.hpp"

namespace wiw::apartment {

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

/// Everything about one instance but its light.
struct Object {
  std::string name;
  std::string category;
  std::map<std::string, std::string> attributes;
  std::int32_t room = kOutside;
  Eigen::Affine3f pose = Eigen::Affine3f::Identity();
  FurnitureShape shape;  // lit at its vertices
  std::vector<Panel> panels;
  bool casts_shadow = true;
};

/// Source of light: a rectangle (half axes `u`, `v`) that shines to the side of `axis`, or a lamp that shines all
/// round.
struct Light {
  Vec3 center, u = Vec3::Zero(), v = Vec3::Zero(), axis = Vec3::Zero();
  Rgb strength = Rgb::Ones();  // radiance of a rectangle times its area; intensity of a lamp; linear
  std::int32_t room = kOutside;
  [[nodiscard]] bool one_sided() const { return !axis.isZero(); }
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
};

/// Floors, ceilings, walls, skirting; then frames, door leaves and windows with their daylight.
void build_walls(Draft& draft);
void build_openings(Draft& draft);
/// Furniture, small objects, pictures and lamps.
void furnish(Draft& draft);
/// The finished scene with baked light.
scene::Scene bake(const Draft& draft, ThreadPool& pool);

}  // namespace wiw::apartment
