// SPDX-License-Identifier: Apache-2.0
#pragma once

#include "wiw/apartment/furniture/catalogue.hpp"

namespace wiw::apartment {

// beds.cpp
void make_bed(FurnitureBuilder& m);
void make_bunk_bed(FurnitureBuilder& m);
void make_nightstand(FurnitureBuilder& m);
// seating.cpp
void make_sofa(FurnitureBuilder& m);
void make_armchair(FurnitureBuilder& m);
void make_chair(FurnitureBuilder& m);
void make_office_chair(FurnitureBuilder& m);
void make_stool(FurnitureBuilder& m);
void make_bench(FurnitureBuilder& m);
void make_pouf(FurnitureBuilder& m);
// tables.cpp
void make_dining_table(FurnitureBuilder& m);
void make_coffee_table(FurnitureBuilder& m);
void make_desk(FurnitureBuilder& m);
void make_side_table(FurnitureBuilder& m);
void make_console(FurnitureBuilder& m);
// storage.cpp
void make_wardrobe(FurnitureBuilder& m);
void make_bookshelf(FurnitureBuilder& m);
void make_dresser(FurnitureBuilder& m);
void make_sideboard(FurnitureBuilder& m);
void make_tv_stand(FurnitureBuilder& m);
void make_shoe_rack(FurnitureBuilder& m);
void make_coat_rack(FurnitureBuilder& m);
void make_wall_shelf(FurnitureBuilder& m);
// kitchen.cpp
void make_counter(FurnitureBuilder& m);
void make_kitchen_sink(FurnitureBuilder& m);
void make_stove(FurnitureBuilder& m);
void make_refrigerator(FurnitureBuilder& m);
void make_wall_cabinet(FurnitureBuilder& m);
void make_range_hood(FurnitureBuilder& m);
// bathroom.cpp
void make_toilet(FurnitureBuilder& m);
void make_bathtub(FurnitureBuilder& m);
void make_shower(FurnitureBuilder& m);
void make_washbasin(FurnitureBuilder& m);
void make_washing_machine(FurnitureBuilder& m);
void make_towel_rail(FurnitureBuilder& m);
void make_laundry_basket(FurnitureBuilder& m);
// electronics.cpp
void make_television(FurnitureBuilder& m);
void make_laptop(FurnitureBuilder& m);
void make_microwave(FurnitureBuilder& m);
void make_kettle(FurnitureBuilder& m);
void make_speaker(FurnitureBuilder& m);
void make_piano(FurnitureBuilder& m);
// decor.cpp
void make_rug(FurnitureBuilder& m);
void make_plant(FurnitureBuilder& m);
void make_picture(FurnitureBuilder& m);
void make_mirror(FurnitureBuilder& m);
void make_clock(FurnitureBuilder& m);
void make_curtain(FurnitureBuilder& m);
void make_radiator(FurnitureBuilder& m);
void make_bin(FurnitureBuilder& m);
void make_toy_box(FurnitureBuilder& m);
// objects.cpp
void make_books(FurnitureBuilder& m);
void make_vase(FurnitureBuilder& m);
void make_cup(FurnitureBuilder& m);
void make_bowl(FurnitureBuilder& m);
void make_bottle(FurnitureBuilder& m);
void make_box(FurnitureBuilder& m);
void make_candles(FurnitureBuilder& m);
void make_photo(FurnitureBuilder& m);
void make_small_plant(FurnitureBuilder& m);
void make_ball(FurnitureBuilder& m);
// lighting.cpp
void make_ceiling_lamp(FurnitureBuilder& m);
void make_pendant(FurnitureBuilder& m);
void make_floor_lamp(FurnitureBuilder& m);
void make_table_lamp(FurnitureBuilder& m);

/// Colour in which the cloth of a burning lamp's shade shines.
Rgb lit_shade(const Rgb& color);
/// Four legs under a plate from y = 0 to `top`; `style` 0 square, 1 tapered and splayed, 2 turned, 3 steel frame.
void add_legs(FurnitureBuilder& m, MaterialId material, float width, float depth, float top, float thickness, int style,
              const Vec3& center = Vec3::Zero());
/// Doors or drawers on the front of a case: `columns` x `rows` fields with handles; the doors of the first
/// `open_columns` columns stand open.
void add_fronts(FurnitureBuilder& m, MaterialId front, MaterialId metal, const Vec3& low, const Vec3& high, int columns,
                int rows, bool drawers, int open_columns = 0);
/// Frame of a leaf that hangs at `hinge` (x and z) and is turned outwards; it covers `low` to `high` when closed, which
/// the design's leaves are told.
Eigen::Affine3f open_leaf(FurnitureBuilder& m, const Vec2& hinge, const Vec3& low, const Vec3& high);
/// Case of boards: sides, top, bottom and back around an open front.
void add_carcass(FurnitureBuilder& m, MaterialId wood, const Vec3& low, const Vec3& high, float board);
/// A row of books standing from x0 to x1 on y, spines towards +z at `z`.
void add_books(FurnitureBuilder& m, float x0, float x1, float y, float z, float clearance, float depth);

}  // namespace wiw::apartment
