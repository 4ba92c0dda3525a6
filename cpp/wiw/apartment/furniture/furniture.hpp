// SPDX-License-Identifier: Apache-2.0
#pragma once

#include "wiw/apartment/furniture/catalogue.hpp"

namespace wiw::apartment {

// beds.cpp
void make_bed(Make& m);
void make_bunk_bed(Make& m);
void make_nightstand(Make& m);
// seating.cpp
void make_sofa(Make& m);
void make_armchair(Make& m);
void make_chair(Make& m);
void make_office_chair(Make& m);
void make_stool(Make& m);
void make_bench(Make& m);
void make_pouf(Make& m);
// tables.cpp
void make_dining_table(Make& m);
void make_coffee_table(Make& m);
void make_desk(Make& m);
void make_side_table(Make& m);
void make_console(Make& m);
// storage.cpp
void make_wardrobe(Make& m);
void make_bookshelf(Make& m);
void make_dresser(Make& m);
void make_sideboard(Make& m);
void make_tv_stand(Make& m);
void make_shoe_rack(Make& m);
void make_coat_rack(Make& m);
void make_wall_shelf(Make& m);
// kitchen.cpp
void make_counter(Make& m);
void make_kitchen_sink(Make& m);
void make_stove(Make& m);
void make_refrigerator(Make& m);
void make_wall_cabinet(Make& m);
void make_range_hood(Make& m);
// bathroom.cpp
void make_toilet(Make& m);
void make_bathtub(Make& m);
void make_shower(Make& m);
void make_washbasin(Make& m);
void make_washing_machine(Make& m);
void make_towel_rail(Make& m);
void make_laundry_basket(Make& m);
// electronics.cpp
void make_television(Make& m);
void make_laptop(Make& m);
void make_microwave(Make& m);
void make_kettle(Make& m);
void make_speaker(Make& m);
void make_piano(Make& m);
// decor.cpp
void make_rug(Make& m);
void make_plant(Make& m);
void make_picture(Make& m);
void make_mirror(Make& m);
void make_clock(Make& m);
void make_curtain(Make& m);
void make_radiator(Make& m);
void make_bin(Make& m);
void make_toy_box(Make& m);
// objects.cpp
void make_books(Make& m);
void make_vase(Make& m);
void make_cup(Make& m);
void make_bowl(Make& m);
void make_bottle(Make& m);
void make_box(Make& m);
void make_candles(Make& m);
void make_photo(Make& m);
void make_small_plant(Make& m);
void make_ball(Make& m);
// lighting.cpp
void make_ceiling_lamp(Make& m);
void make_pendant(Make& m);
void make_floor_lamp(Make& m);
void make_table_lamp(Make& m);

/// Colour in which the cloth of a burning lamp's shade shines.
Rgb lit_shade(const Rgb& color);
/// Four legs under a plate from y = 0 to `top`; `style` 0 square, 1 tapered and splayed, 2 turned, 3 steel frame.
void add_legs(Make& m, MaterialId material, float width, float depth, float top, float thickness, int style,
              const Vec3& center = Vec3::Zero());
/// Doors or drawers on the front of a case: `columns` x `rows` fields with handles; the doors of the first
/// `open_columns` columns stand open.
void add_fronts(Make& m, MaterialId front, MaterialId metal, const Vec3& low, const Vec3& high, int columns, int rows,
                bool drawers, int open_columns = 0);
/// Frame of a leaf that hangs at `hinge` (x and z) and is turned outwards; it covers `low` to `high` when closed, which
/// the design's leaves are told.
Eigen::Affine3f open_leaf(Make& m, const Vec2& hinge, const Vec3& low, const Vec3& high);
/// Case of boards: sides, top, bottom and back around an open front.
void add_carcass(Make& m, MaterialId wood, const Vec3& low, const Vec3& high, float board);
/// A row of books standing from x0 to x1 on y, spines towards +z at `z`.
void add_books(Make& m, float x0, float x1, float y, float z, float clearance, float depth);

}  // namespace wiw::apartment
