// SPDX-License-Identifier: Apache-2.0
#include "wiw/scene/import/category.hpp"

#include <doctest/doctest.h>

using wiw::scene::category_from_name;

TEST_CASE("a category is read from a model's name") {
  CHECK(category_from_name("aws_robomaker_residential_ChairA_01") == "chair");
  CHECK(category_from_name("aws_robomaker_residential_TVCabinet_01") == "tv cabinet");
  CHECK(category_from_name("aws_robomaker_residential_TV_02") == "tv");
  CHECK(category_from_name("aws_robomaker_residential_HouseWallB_01") == "wall");
  CHECK(category_from_name("aws_robomaker_residential_RoomWindow_01") == "window");
  CHECK(category_from_name("KitchenCabinet") == "kitchen cabinet");
  CHECK(category_from_name("coffee-table.003") == "coffee table");
  CHECK(category_from_name("room") == "room");
}

TEST_CASE("names that say nothing give no category") {
  for (const char* name : {"", "nodes[3]", "Mesh_12", "defaultobject", "A_01", "link_visual", "\xc3\xa9"}) {
    CAPTURE(name);
    CHECK(category_from_name(name).empty());
  }
}

TEST_CASE("categories of a scene are unique") {
  wiw::scene::Scene scene;
  CHECK(wiw::scene::category_index(scene, "chair") == 0);
  CHECK(wiw::scene::category_index(scene, "table") == 1);
  CHECK(wiw::scene::category_index(scene, "chair") == 0);
  CHECK(wiw::scene::category_index(scene, "") == wiw::scene::kNone);
}
