// SPDX-License-Identifier: Apache-2.0
#include <doctest/doctest.h>

#include <algorithm>
#include <cmath>
#include <numbers>
#include <pugixml.hpp>

#include "scene/samples.hpp"
#include "wiw/core/error.hpp"
#include "wiw/core/rng.hpp"
#include "wiw/scene/measure.hpp"
#include "wiw/scene/sdf.hpp"
#include "wiw/scene/sdf/pose.hpp"
#include "wiw/scene/sdf/primitives.hpp"

namespace {

/// Volume enclosed, by the divergence theorem: positive if all triangles face outwards.
double volume(const wiw::scene::Mesh& mesh) {
  double sum = 0.;
  for (const auto& t : mesh.triangles) {
    const Eigen::Vector3d a = mesh.positions[t[0]].cast<double>();
    sum += a.dot(mesh.positions[t[1]].cast<double>().cross(mesh.positions[t[2]].cast<double>())) / 6.;
  }
  return sum;
}

std::string world(const std::string& content) {
  return "<sdf version=\"1.9\"><world name=\"w\">" + content + "</world></sdf>";
}

/// A file of one model.
std::string sdf(const std::string& content) {
  std::string text = "<sdf version=\"1.9\">";
  return text.append(content).append("</sdf>");
}

std::string model(const std::string& content, const std::string& name = "m") {
  return "<model name=\"" + name + "\">" + content + "</model>";
}

const std::string kUnitBox = "<visual name=\"v\"><geometry><box><size>1 1 1</size></box></geometry></visual>";

wiw::scene::ScenePtr load(const Folder& folder, const std::string& content) {
  return wiw::scene::load_sdf_world(folder.write("w.sdf", world(content)));
}

/// Centre of an instance in the file's axes: (x, y, z) from (x, z, -y).
Eigen::Vector3f centre(const wiw::scene::Scene& scene, std::size_t i = 0) {
  const Eigen::Vector3f c = instance_bounds(scene, scene.instances.at(i)).center();
  return {c.x(), -c.z(), c.y()};
}

}  // namespace

TEST_CASE("primitives are closed, face outwards and have the right volume") {
  using wiw::scene::sdf::Geometry;
  using wiw::scene::sdf::primitive_mesh;
  using wiw::scene::sdf::ShapeKind;
  const double pi = std::numbers::pi;
  CHECK(volume(primitive_mesh({.shape = ShapeKind::kBox, .size = {2, 3, 4}})) == doctest::Approx(24.));
  CHECK(volume(primitive_mesh({.shape = ShapeKind::kSphere, .size = {2, 2, 2}})) ==
        doctest::Approx(32. * pi / 3.).epsilon(0.02));
  CHECK(volume(primitive_mesh({.shape = ShapeKind::kCylinder, .size = {2, 2, 3}})) ==
        doctest::Approx(12. * pi).epsilon(0.01));
  for (const ShapeKind shape : {ShapeKind::kBox, ShapeKind::kSphere, ShapeKind::kCylinder}) {
    const wiw::scene::Mesh mesh = primitive_mesh({.shape = shape, .size = {1, 1, 2}});
    for (const auto& t : mesh.triangles) {  // vertex normals point to the side that the triangle faces
      const Eigen::Vector3f face =
          (mesh.positions[t[1]] - mesh.positions[t[0]]).cross(mesh.positions[t[2]] - mesh.positions[t[0]]);
      for (int corner = 0; corner < 3; ++corner) CHECK(face.dot(mesh.normals[t[corner]]) > 0.f);
    }
  }
  const wiw::scene::Mesh plane =
      primitive_mesh({.shape = ShapeKind::kPlane, .size = {2, 4, 1}, .normal = Eigen::Vector3d::UnitX()});
  CHECK(plane.triangles.size() == 2);
  for (std::size_t i = 0; i < 4; ++i) {
    CHECK(plane.positions[i].x() == doctest::Approx(0.));
    CHECK(plane.normals[i].isApprox(Eigen::Vector3f::UnitX(), 1e-6f));
  }
}

TEST_CASE("a pose is Rz(yaw) Ry(pitch) Rx(roll), in radians, degrees or as a quaternion") {
  for (std::uint64_t key = 0; key < 50; ++key) {
    wiw::Rng rng(wiw::fold_key({key}));
    double v[6];
    for (double& value : v) value = 4. * rng.uniform() - 2.;
    // The textbook matrix of extrinsic roll, pitch, yaw, written out.
    const auto [cr, sr, cp, sp, cy, sy] =
        std::tuple(std::cos(v[3]), std::sin(v[3]), std::cos(v[4]), std::sin(v[4]), std::cos(v[5]), std::sin(v[5]));
    Eigen::Matrix3d expected;
    expected << cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr, sy * cp, sy * sp * sr + cy * cr,
        sy * sp * cr - cy * sr, -sp, cp * sr, cp * cr;
    const auto parse = [](const std::string& pose) {
      pugi::xml_document document;
      document.load_string(("<link>" + pose + "</link>").c_str());
      return wiw::scene::sdf::own_pose(document.child("link"), "test.sdf");
    };
    std::string radians = "<pose>";
    std::string degrees = "<pose degrees=\"true\">";
    for (int i = 0; i < 6; ++i) {
      radians += std::to_string(v[i]) + " ";
      degrees += std::to_string(i < 3 ? v[i] : v[i] * 180. / std::numbers::pi) + "\n";
    }
    const Eigen::Quaterniond q(expected);
    const std::string quaternion = "<pose rotation_format=\"quat_xyzw\">" + std::to_string(v[0]) + " " +
                                   std::to_string(v[1]) + " " + std::to_string(v[2]) + "  " + std::to_string(q.x()) +
                                   " " + std::to_string(q.y()) + " " + std::to_string(q.z()) + " " +
                                   std::to_string(q.w()) + "</pose>";
    for (const std::string& text : {radians + "</pose>", degrees + "</pose>", quaternion}) {
      const Eigen::Isometry3d pose = parse(text);
      CHECK((pose.linear() - expected).norm() < 2e-5);
      CHECK((pose.translation() - Eigen::Vector3d(v[0], v[1], v[2])).norm() < 2e-5);
    }
  }
}

TEST_CASE("poses chain from world to visual and follow relative_to") {
  const Folder folder;
  const std::string turned = "<pose>1 0 0 0 0 1.5707963</pose>";
  const auto chained =
      load(folder, model(turned + "<link name=\"l\"><pose>0 2 0 0 0 0</pose><visual name=\"v\"><pose>0 0 3 0 0 0</pose>"
                                  "<geometry><box><size>1 1 1</size></box></geometry></visual></link>"));
  CHECK((centre(*chained) - Eigen::Vector3f(-1, 0, 3)).norm() < 1e-5f);  // 2 along the model's y is -2 along x

  const auto relative = load(folder, model("<frame name=\"f\"><pose>0 0 5 0 0 0</pose></frame><link name=\"a\"><pose "
                                           "relative_to=\"f\">1 0 0 0 0 0</pose></link>"
                                           "<link name=\"b\"><pose relative_to=\"a\">0 1 0 0 0 0</pose>" +
                                           kUnitBox + "</link>"));
  CHECK((centre(*relative) - Eigen::Vector3f(1, 1, 5)).norm() < 1e-5f);
}

TEST_CASE("relative_to finds every kind of frame of its model") {
  const Folder folder;
  const auto place = [&](const std::string& content) {
    return centre(*wiw::scene::load_sdf_world(folder.write("f.sdf", world(content))));
  };
  const auto is = [](const Eigen::Vector3f& found, float x, float y, float z) {
    CAPTURE(found.transpose());
    CHECK((found - Eigen::Vector3f(x, y, z)).norm() < 1e-5f);
  };
  const auto box = [](const std::string& frame) {
    return "<visual name=\"v\"><pose relative_to=\"" + frame +
           "\">1 0 0 0 0 0</pose><geometry><box><size>1 1 1</size></box></geometry></visual>";
  };
  const std::string frame = "<frame name=\"f\"><pose>0 0 5 0 0 1.5707963</pose></frame>";
  const auto link = [](const std::string& content) { return "<link name=\"l\">" + content + "</link>"; };
  is(place(model(frame + link("<pose>0 7 0 0 0 0</pose>" + box("l")))), 1, 7, 0);
  is(place(model(frame + link("<pose>0 7 0 0 0 0</pose>" + box("f")))), 0, 1, 5);
  is(place(model(frame + link("<pose>0 7 0 0 0 0</pose>" + box("__model__")))), 1, 0, 0);

  // A joint's pose is by default relative to its child.
  const std::string base = "<link name=\"base\"><pose>0 0 2 0 0 0</pose></link>";
  const std::string joint = "<joint name=\"j\"><parent>l</parent><child>base</child><pose>0 3 0 0 0 0</pose></joint>";
  is(place(model(base + joint + link("<pose relative_to=\"j\">4 0 0 0 0 0</pose>" + kUnitBox))), 4, 3, 2);
  // A frame's, to what it is attached to.
  const std::string attached = "<frame name=\"g\" attached_to=\"base\"><pose>0 1 0 0 0 0</pose></frame>";
  is(place(model(base + attached + link(box("g")))), 1, 1, 2);

  const std::string inner = model("<pose>0 0 9 0 0 0</pose>" + base, "inner");
  is(place(model(inner + link(box("inner")))), 1, 0, 9);
  is(place(model(inner + link(box("inner::base")))), 1, 0, 11);
  is(place(model("<pose>3 0 0 0 0 0</pose>" + base, "other") +
           model("<pose relative_to=\"other::base\">0 1 0 0 0 0</pose>" + link(kUnitBox))),
     3, 1, 2);

  // placement_frame: the pose is that frame's, not the model's origin's.
  const std::string placed = link("<pose>0 0 2 0 0 0</pose>" + kUnitBox) + "</model>";
  is(place("<model name=\"m\" placement_frame=\"l\"><pose>5 0 0 0 0 0</pose>" + placed), 5, 0, 0);
  folder.write("models/part/model.sdf", sdf("<model name=\"part\">" + placed));
  const std::string include = "<include><uri>model://part</uri><pose>5 0 0 0 0 0</pose>";
  is(place(include + "</include>"), 5, 0, 2);
  is(place(include + "<placement_frame>l</placement_frame></include>"), 5, 0, 0);
}

TEST_CASE("what is relative to nothing is left out by name, and the rest is drawn") {
  const Folder folder;
  const std::string good = model("<link name=\"l\">" + kUnitBox + "</link>", "good");
  const auto lost = [](const std::string& frame) { return "<pose relative_to=\"" + frame + "\">0 0 0 0 0 0</pose>"; };
  std::string visual = "<visual name=\"w\">";
  visual.append(lost("q")).append("<geometry><box><size>1 1 1</size></box></geometry></visual>");
  const auto scene = load(folder, good + model("<link name=\"l\">" + kUnitBox + visual + "</link>", "half") +
                                      model("<link name=\"a\">" + lost("x::y") + kUnitBox + "</link>", "none") +
                                      model(lost("nowhere") + "<link name=\"l\">" + kUnitBox + "</link>", "moved"));
  CHECK(scene->instances.size() == 2);
  CHECK(scene->triangle_count() == 24);
  REQUIRE(scene->warnings.size() == 3);
  CHECK(scene->warnings[0].find("the pose of 'w' is relative to 'q', which is no link, joint, frame or model of the "
                                "model 'half'; left out") != std::string::npos);
  CHECK(scene->warnings[1].find("'a' is relative to 'x::y'") != std::string::npos);
  CHECK(scene->warnings[2].find("'moved' is relative to 'nowhere', which is no link, joint, frame or model of the "
                                "world 'w'") != std::string::npos);
  CHECK_THROWS_WITH_AS(
      load(folder, model("<link name=\"a\"><pose relative_to=\"x\">0 0 0 0 0 0</pose>" + kUnitBox + "</link>")),
      doctest::Contains("relative to 'x', which is no link"), wiw::FileError);
  CHECK_THROWS_WITH_AS(
      load(folder, model("<link name=\"a\"><pose relative_to=\"b\">0 0 0 0 0 0</pose>" + kUnitBox + "</link>" +
                         "<link name=\"b\"><pose relative_to=\"a\">0 0 0 0 0 0</pose></link>")),
      doctest::Contains("relative to itself"), wiw::FileError);
}

TEST_CASE("nested models are instances of their own") {
  const Folder folder;
  const std::string inner = model("<pose>0 0 1 0 0 0</pose><link name=\"l\">" + kUnitBox + "</link>", "Cup_01");
  const auto scene =
      load(folder, model("<pose>5 0 0 0 0 0</pose><link name=\"l\">" + kUnitBox + "</link>" + inner, "Table_02"));
  REQUIRE(scene->instances.size() == 2);
  CHECK(scene->instances[0].name == "Table_02");
  CHECK(scene->instances[1].name == "Table_02/Cup_01");
  CHECK(scene->categories == std::vector<std::string>{"table", "cup"});
  CHECK((centre(*scene, 1) - Eigen::Vector3f(5, 0, 1)).norm() < 1e-5f);
  CHECK(scene->instances[0].meshes == scene->instances[1].meshes);  // the same box
}

TEST_CASE("mesh visuals: scale, submesh, colour in place of the mesh's own, DAE axes left as they are") {
  const Folder folder;
  folder.write("lamp.dae", sample_dae());
  const auto visual = [](const std::string& mesh, const std::string& material = "") {
    return model("<link name=\"l\"><visual name=\"v\"><geometry><mesh><uri>lamp.dae</uri>" + mesh +
                 "</mesh></geometry>" + material + "</visual></link>");
  };
  const auto plain = load(folder, visual(""));
  CHECK(
      plain->bounds().max().isApprox(Eigen::Vector3f(1, 0, 0), 1e-5f));  // a Z-up square on the floor: x right, y to -z
  CHECK(plain->bounds().min().isApprox(Eigen::Vector3f(0, 0, -1), 1e-5f));
  CHECK(load(folder, visual("<scale>2 3 4</scale>"))->bounds().min().isApprox(Eigen::Vector3f(0, 0, -3), 1e-5f));
  CHECK(load(folder, visual("<submesh><name>Lamp</name></submesh>"))->warnings.empty());
  const auto both = load(folder, visual("") + visual("<submesh><name>Shade</name></submesh>"));
  REQUIRE(both->warnings.size() == 1);
  CHECK(both->warnings[0].find("has no part 'Shade'") != std::string::npos);

  const auto red = load(folder, visual("", "<material><script><name>Gazebo/Red</name></script></material>"));
  CHECK(red->materials.at(static_cast<std::size_t>(red->meshes[0].material)).base_color == Eigen::Vector4f(1, 0, 0, 1));
  const auto unknown = load(folder, visual("", "<material><script><name>My/Wood</name></script></material>"));
  REQUIRE(unknown->warnings.size() == 1);
  CHECK(unknown->warnings[0].find("'My/Wood' is not known") != std::string::npos);
}

TEST_CASE("what is not supported is named, what is wrong is refused") {
  const Folder folder;
  const std::string box = model("<link name=\"l\">" + kUnitBox + "</link>");
  const auto scene = load(
      folder, box + model("<link name=\"l\"><visual name=\"v\"><geometry><heightmap/></geometry></visual></link>") +
                  "<actor name=\"a\"/>");
  REQUIRE(scene->warnings.size() == 2);
  CHECK(scene->warnings[0].find("<heightmap> geometry is not supported") != std::string::npos);
  CHECK(scene->warnings[1].find("<actor> elements") != std::string::npos);
  const auto geometry = [&](const std::string& shape) {
    return model("<link name=\"l\"><visual name=\"v\"><geometry>" + shape + "</geometry></visual></link>");
  };
  CHECK_THROWS_AS(load(folder, geometry("<box><size>1 2</size></box>")), wiw::FileError);
  CHECK_THROWS_WITH_AS(load(folder, geometry("<sphere><radius>-1</radius></sphere>")),
                       doctest::Contains("should be positive"), wiw::FileError);
  CHECK_THROWS_WITH_AS(load(folder, ""), doctest::Contains("places no model"), wiw::FileError);
}

TEST_CASE("poses and sizes that overflow are the world's error") {
  const Folder folder;
  const auto refused = [&](const std::string& content) {
    CHECK_THROWS_WITH_AS(load(folder, content), doctest::Contains("w.sdf: "), wiw::FileError);
  };
  refused(model("<pose>1e300 0 0 0 0 0</pose><link name=\"l\">" + kUnitBox + "</link>"));
  refused(model("<pose>1e8 0 0 0 0 0</pose><link name=\"l\">" + kUnitBox + "</link>"));
  refused(
      model("<link name=\"l\"><visual name=\"v\"><geometry><box><size>1e39 1 1</size></box></geometry></visual>"
            "</link>"));
}

TEST_CASE("includes that multiply are counted and read once") {
  const Folder folder;
  std::string leaf = "<sdf version=\"1.9\"><model name=\"m\"><link name=\"l\">" + kUnitBox + "</link></model></sdf>";
  folder.write("f4.sdf", leaf);
  for (const char level : {'0', '1', '2', '3'}) {
    const std::string next{'f', static_cast<char>(level + 1)};
    std::string includes;
    for (int i = 0; i < 5; ++i) {
      includes.append("<include><uri>").append(next).append(".sdf</uri><name>n").append(std::to_string(i));
      includes.append("</name></include>");
    }
    folder.write(std::string{'f', level} + ".sdf", sdf(model(includes)));
  }
  const auto file = folder.write("w.sdf", world("<include><uri>f0.sdf</uri></include>"));
  wiw::scene::ImportTrace trace;
  CHECK(wiw::scene::load_sdf_world(file, {.trace = &trace})->instances.size() == 625);
  CHECK(trace.read.size() == 6);
  CHECK_THROWS_WITH_AS(wiw::scene::load_sdf_world(file, {.limits = {.nodes = 1000}}),
                       doctest::Contains("has 1001 placed models and visuals, more than the limit of 1000"),
                       wiw::FileError);
}

TEST_CASE("a model.config that is missing or unusable is followed") {
  const Folder folder;
  const auto file = folder.write("worlds/w.world", world("<include><uri>model://thing</uri></include>"));
  const auto thing = [&](const std::string& name, const std::string& size) {
    folder.write("models/thing/" + name, sdf(model("<link name=\"l\"><visual name=\"v\"><geometry><box><size>" + size +
                                                   "</size></box></geometry></visual></link>")));
  };
  thing("model.sdf", "1 1 1");
  thing("model2.sdf", "2 2 2");
  const auto config = folder.path() / "models/thing/model.config";
  wiw::scene::ImportTrace without;
  CHECK(wiw::scene::load_sdf_world(file, {.trace = &without})->bounds().sizes().isApproxToConstant(1.f));
  CHECK(std::ranges::find(without.absent, config) != without.absent.end());

  folder.write("models/thing/model.config", "<model><sdf>model2.sdf</sdf></model>");
  wiw::scene::ImportTrace with;
  CHECK(wiw::scene::load_sdf_world(file, {.trace = &with})->bounds().sizes().isApproxToConstant(2.f));
  CHECK(std::ranges::find(with.read, config) != with.read.end());
  CHECK_THROWS_WITH_AS(wiw::scene::load_sdf_world(file, {.limits = {.file_bytes = 35}}),
                       doctest::Contains("limits.file_bytes"), wiw::FileError);

  folder.write("models/thing/model.config", "<model><sdf>");
  CHECK_THROWS_WITH_AS(wiw::scene::load_sdf_world(file), doctest::Contains("model.config: is not well-formed XML"),
                       wiw::FileError);
}

TEST_CASE("the meshes of a world share one texture budget") {
  const Folder folder;
  std::string content;
  folder.write("sample.mtl", "newmtl wood\nmap_Kd huge.bmp\n");
  folder.write("huge.bmp", sample_bmp(512));
  for (const std::string name : {"a", "b", "c"}) {
    folder.write(name + ".obj", sample_obj());
    content += model("<link name=\"l\"><visual name=\"v\"><geometry><mesh><uri>" + name +
                         ".obj</uri></mesh></geometry></visual></link>",
                     name);
  }
  const auto file = folder.write("w.sdf", world(content));
  CHECK(wiw::scene::load_sdf_world(file, {.limits = {.texture_bytes = 3 << 20}})->instances.size() == 3);
  CHECK_THROWS_WITH_AS(wiw::scene::load_sdf_world(file, {.limits = {.texture_bytes = (3 << 20) - 1}}),
                       doctest::Contains("has 3145728 bytes of decoded textures with other models'"), wiw::FileError);
}

TEST_CASE("limits hold over all placements of a world") {
  const Folder folder;
  const auto file = folder.write("w.world", world(model("<link name=\"a\">" + kUnitBox + "</link>") +
                                                  model("<link name=\"b\">" + kUnitBox + "</link>", "n")));
  CHECK(wiw::scene::load_sdf_world(file)->triangle_count() == 24);
  CHECK_THROWS_WITH_AS(wiw::scene::load_sdf_world(file, {.limits = {.triangles = 23}}),
                       doctest::Contains("has 24 triangles"), wiw::FileError);
}
