// SPDX-License-Identifier: Apache-2.0
#include "wiw/scene/sdf.hpp"

#include <doctest/doctest.h>

#include <algorithm>
#include <numbers>
#include <set>

#include "scene/files.hpp"
#include "wiw/core/error.hpp"
#include "wiw/scene/measure.hpp"

namespace {

const char* kTwoBoxes = R"(<sdf version="1.6"><world name="w">
  <include><uri>model://sun</uri></include>
  <model name="left"><pose>1 2 3 0 0 1.5707963267948966</pose><include><uri>model://BoxA_01</uri></include></model>
  <include><name>right</name><uri>model://BoxA_01</uri><pose>4 0 0 0 0 0</pose></include>
  <include><uri>model://nowhere</uri></include>
</world></sdf>)";

const char* kBox = R"(<sdf version="1.6"><model name="BoxA_01"><link name="link"><pose>0 0 1 0 0 0</pose>
  <visual name="v"><geometry><box><size>2 4 6</size></box></geometry>
  <material><ambient>0.1 0.1 0.1 1</ambient><diffuse>0.2 0.4 0.6 1</diffuse></material></visual>
</link></model></sdf>)";

wiw::scene::ScenePtr two_boxes(const Folder& folder) {
  folder.write("models/BoxA_01/model.sdf", kBox);
  return wiw::scene::load_sdf_world(folder.write("worlds/w.world", kTwoBoxes));
}

bool mentions(const std::vector<std::string>& warnings, const std::string& text) {
  return std::ranges::any_of(warnings, [&](const std::string& w) { return w.find(text) != std::string::npos; });
}

}  // namespace

TEST_CASE("a world places models, shares their meshes and turns Z up to Y up") {
  const Folder folder;
  const wiw::scene::ScenePtr scene = two_boxes(folder);
  REQUIRE(scene->instances.size() == 2);
  CHECK(scene->instances[0].name == "left");
  CHECK(scene->instances[1].name == "right");
  CHECK(scene->categories == std::vector<std::string>{"box"});
  CHECK(scene->meshes.size() == 1);
  CHECK(scene->instances[0].meshes == scene->instances[1].meshes);
  CHECK(scene->materials.at(static_cast<std::size_t>(scene->meshes[0].material))
            .base_color.isApprox(Eigen::Vector4f(0.2f, 0.4f, 0.6f, 1.f)));

  // The left box is 2 x 4 x 6, turned by 90 degrees about z: 4 x 2 x 6 about (1, 2, 4); y becomes -z.
  const Eigen::AlignedBox3f left = wiw::scene::instance_bounds(*scene, scene->instances[0]);
  CHECK(left.min().isApprox(Eigen::Vector3f(-1, 1, -3), 1e-5f));
  CHECK(left.max().isApprox(Eigen::Vector3f(3, 7, -1), 1e-5f));
  CHECK(wiw::scene::instance_bounds(*scene, scene->instances[1]).center().isApprox(Eigen::Vector3f(4, 1, 0), 1e-5f));

  CHECK(mentions(scene->warnings, "model://nowhere"));
  CHECK_FALSE(mentions(scene->warnings, "sun"));
  CHECK(scene->attributes.at("up") == "Z (Gazebo SDF)");
}

TEST_CASE("the real house loads whole") {
  const auto data = test_data();
  if (data.empty()) {
    MESSAGE("skipped: WIW_TEST_DATA is not set and ../shared/data does not exist");
    return;
  }
  wiw::scene::ImportTrace trace;
  const wiw::scene::ScenePtr scene =
      wiw::scene::load_sdf_world(data / "small_house/worlds/small_house.world", {.trace = &trace});
  CHECK(scene->instances.size() == 87);
  std::size_t of_meshes = 0;
  std::set<std::uint32_t> shared;
  for (const wiw::scene::Instance& instance : scene->instances) {
    shared.insert(instance.meshes.begin(), instance.meshes.end());
    if (scene->categories[static_cast<std::size_t>(instance.category)] == "ball") continue;
    for (const std::uint32_t mesh : instance.meshes) of_meshes += scene->meshes[mesh].triangles.size();
  }
  CHECK(of_meshes == 145'844 - 2);  // the wall model has two triangles without area
  CHECK(shared.size() == scene->meshes.size());
  CHECK(scene->meshes.size() < 90);  // chairs and other things placed twice share theirs
  const Eigen::Vector3f size = scene->bounds().sizes();
  CHECK(size.isApprox(Eigen::Vector3f(19.f, 3.f, 11.4f), 1e-3f));
  CHECK(std::ranges::find(scene->categories, "chair") != scene->categories.end());

  REQUIRE(scene->warnings.size() == 2);
  CHECK(mentions(scene->warnings, "aws_Carpet_01.png"));
  CHECK(mentions(scene->warnings, "photos/DeskPortraitB_02.jpg"));
}

TEST_CASE("damaged worlds are refused by name and cause") {
  const Folder folder;
  CHECK_THROWS_WITH_AS(wiw::scene::load_sdf_world(folder.path() / "none.world"), doctest::Contains("no such file"),
                       wiw::FileError);
  CHECK_THROWS_WITH_AS(wiw::scene::load_sdf_world(folder.write("cut.world", "<sdf><world>")),
                       doctest::Contains("not well-formed XML"), wiw::FileError);
  CHECK_THROWS_WITH_AS(wiw::scene::load_sdf_world(folder.write("html.world", "<html/>")),
                       doctest::Contains("no <sdf> element"), wiw::FileError);
  const char* bad_pose = R"(<sdf><world><model name="m"><pose>1 2 x</pose><link/></model></world></sdf>)";
  CHECK_THROWS_WITH_AS(wiw::scene::load_sdf_world(folder.write("pose.world", bad_pose)),
                       doctest::Contains("should hold 6 numbers"), wiw::FileError);
  folder.write("models/loop/model.sdf",
               R"(<sdf><model name="loop"><include><uri>model://loop</uri></include></model></sdf>)");
  const char* loop = R"(<sdf><world><include><uri>model://loop</uri></include></world></sdf>)";
  CHECK_THROWS_WITH_AS(wiw::scene::load_sdf_world(folder.write("loop.world", loop)),
                       doctest::Contains("nested more than"), wiw::FileError);
}
