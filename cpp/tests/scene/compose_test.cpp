// SPDX-License-Identifier: Apache-2.0
#include <doctest/doctest.h>

#include <array>
#include <bit>

#include "scene/samples.hpp"
#include "wiw/core/error.hpp"
#include "wiw/scene/assemble.hpp"
#include "wiw/scene/import.hpp"
#include "wiw/scene/import/ply_surface.hpp"
#include "wiw/scene/measure.hpp"
#include "wiw/scene/relabel.hpp"

using namespace wiw;
using namespace wiw::scene;

namespace {

SceneLabels two_instances() {
  SceneLabels labels;
  labels.categories = {"chair"};
  labels.instances.resize(2);
  labels.instances[0].name = "a";
  labels.instances[1].name = "b";
  labels.instances[1].category = 0;
  return labels;
}

double area_of(const Scene& scene, const Instance& instance) {
  double area = 0;
  for (const std::uint32_t index : instance.meshes) {
    const Mesh& mesh = scene.meshes[index];
    for (const Triangle& t : mesh.triangles) {
      const Eigen::Vector3f a = mesh.positions[t[0]];
      area += 0.5 * (mesh.positions[t[1]] - a).cross(mesh.positions[t[2]] - a).norm();
    }
  }
  return area;
}

/// A binary PLY of a quad and a triangle, with an object for each.
std::string labelled_ply(bool big_endian = false, const std::string& label = "object_id") {
  const std::array<float, 15> positions{0, 0, 0, 1, 0, 0, 1, 1, 0, 0, 1, 0, 2, 0, 0};
  std::string bytes = std::string("ply\nformat binary_") + (big_endian ? "big" : "little") +
                      "_endian 1.0\nelement vertex 5\nproperty float x\nproperty float y\nproperty float z\n"
                      "property uchar red\nproperty uchar green\nproperty uchar blue\n"
                      "element face 2\nproperty list uchar int vertex_indices\nproperty int " +
                      label + "\nproperty short extra\nend_header\n";
  const auto put = [&](auto value) {
    auto raw = std::bit_cast<std::array<char, sizeof(value)>>(value);
    if (big_endian) std::ranges::reverse(raw);
    bytes.append(raw.data(), raw.size());
  };
  for (std::size_t i = 0; i < 5; ++i) {
    for (std::size_t axis = 0; axis < 3; ++axis) put(positions[3 * i + axis]);
    for (int channel = 0; channel < 3; ++channel) put(static_cast<std::uint8_t>(10 * i + channel));
  }
  put(std::uint8_t{4});
  for (const std::int32_t corner : {0, 1, 2, 3}) put(corner);
  put(std::int32_t{7});
  put(std::int16_t{1});
  put(std::uint8_t{3});
  for (const std::int32_t corner : {1, 4, 2}) put(corner);
  put(std::int32_t{-1});
  put(std::int16_t{1});
  return bytes;
}

}  // namespace

TEST_CASE("relabel: whole triangles go to the instances that they name, in the world") {
  const Folder folder;
  const auto scene = load_mesh(folder.write("a.glb", sample_glb()), {.up = Up::kZ});
  const std::array<LabelledPiece, 2> pieces{{{.triangle = 0, .instance = 2}, {.triangle = 1, .instance = 1}}};
  const auto cut = relabel(*scene, pieces, two_instances());
  REQUIRE(cut->instances.size() == 2);
  CHECK(cut->instances[1].id == 2);
  CHECK(cut->categories == std::vector<std::string>{"chair"});
  CHECK(area_of(*cut, cut->instances[0]) == doctest::Approx(0.5));
  CHECK(area_of(*cut, cut->instances[1]) == doctest::Approx(0.5));
  CHECK(cut->bounds().min().isApprox(scene->bounds().min()));
  CHECK(cut->textures.size() == 1);
  const TriangleSoup before = world_triangles(*scene);
  const TriangleSoup after = world_triangles(*cut);
  CHECK(after.vertices[after.triangles[0][0]].isApprox(before.vertices[before.triangles[1][0]]));
}

TEST_CASE("relabel: pieces of a triangle keep its surface and its texture coordinates") {
  const Folder folder;
  const auto scene = load_mesh(folder.write("a.glb", sample_glb()));
  LabelledPiece near{.triangle = 0, .instance = 1};
  LabelledPiece far{.triangle = 0, .instance = 2};
  near.corners << 1, 0, 0, 0.5f, 0.5f, 0, 0.5f, 0, 0.5f;
  far.corners << 0.5f, 0.5f, 0, 0, 1, 0, 0, 0, 1;
  const auto cut = relabel(*scene, std::array{near, far}, two_instances());
  CHECK(area_of(*cut, cut->instances[0]) == doctest::Approx(0.125));
  CHECK(area_of(*cut, cut->instances[1]) == doctest::Approx(0.25));
  for (const Mesh& mesh : cut->meshes) {
    for (std::size_t i = 0; i < mesh.positions.size(); ++i) {
      CHECK((mesh.uv[i] - Eigen::Vector2f(mesh.positions[i].x(), 1.f - mesh.positions[i].y())).norm() < 1e-6f);
    }
  }
  CHECK(relabel(*scene, std::array{near}, two_instances())->instances[1].meshes.empty());
}

TEST_CASE("relabel refuses pieces of nothing") {
  const Folder folder;
  const auto scene = load_mesh(folder.write("a.glb", sample_glb()));
  CHECK_THROWS_AS(relabel(*scene, std::array{LabelledPiece{.triangle = 2, .instance = 1}}, two_instances()),
                  ArgumentError);
  CHECK_THROWS_AS(relabel(*scene, std::array{LabelledPiece{.triangle = 0, .instance = 3}}, two_instances()),
                  ArgumentError);
  CHECK_THROWS_AS(relabel(*scene, std::array{LabelledPiece{}}, two_instances()), ArgumentError);
}

TEST_CASE("assemble: placements scale and share, instances have one pose") {
  const Folder folder;
  const std::vector<ScenePtr> parts{load_mesh(folder.write("a.glb", sample_glb()))};
  Eigen::Affine3f moved(Eigen::Translation3f(3, 0, 0));
  const Eigen::Affine3f turned = moved * Eigen::AngleAxisf(1.5707963f, Eigen::Vector3f::UnitY());
  const Eigen::Affine3f wide = moved * Eigen::Scaling(2.f, 1.f, 1.f);
  const std::array<Placement, 3> placements{{{0, 1, turned}, {0, 2, moved}, {0, 2, wide}}};
  const auto scene = assemble(parts, placements, two_instances());
  CHECK(scene->instances[0].meshes.size() == 1);
  CHECK(scene->instances[1].meshes.size() == 2);
  CHECK(scene->instances[0].meshes[0] == scene->instances[1].meshes[0]);
  const auto turned_box = instance_bounds(*scene, scene->instances[0]);
  CHECK((turned_box.min() - Eigen::Vector3f(3, 0, -1)).norm() < 1e-5f);
  CHECK((turned_box.max() - Eigen::Vector3f(3, 1, 0)).norm() < 1e-5f);
  CHECK((instance_bounds(*scene, scene->instances[1]).max() - Eigen::Vector3f(5, 1, 0)).norm() < 1e-5f);
  CHECK(scene->materials[scene->meshes[1].material].texture == 0);
  CHECK_THROWS_AS(assemble(parts, std::array<Placement, 1>{{{1, 1, moved}}}, two_instances()), ArgumentError);
  CHECK_THROWS_AS(assemble(parts, std::array<Placement, 1>{{{0, 3, moved}}}, two_instances()), ArgumentError);
}

TEST_CASE("PLY: a number for each face, in both byte orders") {
  const Folder folder;
  for (const bool big_endian : {false, true}) {
    const PlySurface surface = read_ply_surface(folder.write("a.ply", labelled_ply(big_endian)), "object_id");
    CHECK(surface.vertices.size() == 5);
    CHECK(surface.vertices[4] == Eigen::Vector3f(2, 0, 0));
    CHECK(surface.colors[2] == Eigen::Matrix<std::uint8_t, 4, 1>(20, 21, 22, 255));
    CHECK(surface.triangles.size() == 3);
    CHECK(surface.labels == std::vector<std::int64_t>{7, 7, -1});
  }
}

TEST_CASE("PLY: files without labels, whole faces or vertices are refused") {
  const Folder folder;
  const std::string whole = labelled_ply();
  CHECK_THROWS_AS(read_ply_surface(folder.write("a.ply", labelled_ply(false, "other")), "object_id"), FileError);
  for (std::size_t length = 0; length < whole.size(); ++length) {
    CHECK_THROWS_AS(read_ply_surface(folder.write("a.ply", whole.substr(0, length)), "object_id"), FileError);
  }
  std::string wrong = whole;
  wrong[whole.size() - 7] = 100;  // the last face's last corner is vertex 100 of 5 (or its label, in another order)
  wrong[whole.size() - 10] = 100;
  CHECK_THROWS_AS(read_ply_surface(folder.write("a.ply", wrong), "object_id"), FileError);
  CHECK_THROWS_AS(read_ply_surface(folder.write("a.ply", whole), "object_id", {.triangles = 2}), FileError);
}

TEST_CASE("the share of the surface without its texture is that of what is drawn") {
  const Folder folder;
  CHECK(missing_texture_share(*load_mesh(folder.write("a.glb", sample_glb()))) == 0);
  GlbParts basis;
  basis.texture = R"({"extensions":{"KHR_texture_basisu":{"source":0}}})";
  basis.image = sample_ktx2();
  const auto undecoded = load_mesh(folder.write("b.glb", sample_glb(basis)));
  CHECK(missing_texture_share(*undecoded) == 1);
  CHECK(undecoded->materials[0].base_color[0] < 0.8f);  // grey, not white
  GlbParts damaged;
  damaged.image = "no image";
  CHECK(missing_texture_share(*load_mesh(folder.write("c.glb", sample_glb(damaged)))) == 1);
}
