// SPDX-License-Identifier: Apache-2.0
#include "wiw/scene/import.hpp"

#include <doctest/doctest.h>

#include <algorithm>
#include <limits>

#include "scene/samples.hpp"
#include "wiw/core/error.hpp"
#include "wiw/scene/import/mesh_baker.hpp"
#include "wiw/scene/measure.hpp"

using wiw::FileError;
using wiw::scene::load_mesh;
using wiw::scene::Up;

namespace {

const wiw::scene::Material& material_of(const wiw::scene::Scene& scene, std::size_t mesh = 0) {
  return scene.materials.at(static_cast<std::size_t>(scene.meshes.at(mesh).material));
}

bool same_box(const Eigen::AlignedBox3f& box, const Eigen::Vector3f& low, const Eigen::Vector3f& high) {
  return (box.min() - low).norm() < 1e-5f && (box.max() - high).norm() < 1e-5f;
}

}  // namespace

TEST_CASE("GLB: geometry, embedded texture, category and the Y-up rule") {
  const Folder folder;
  const auto scene = load_mesh(folder.write("room.glb", sample_glb()));
  CHECK(scene->warnings.empty());
  CHECK(scene->attributes.at("up") == "Y (glTF specification)");
  REQUIRE(scene->instances.size() == 1);
  CHECK(scene->instances[0].name == "Chair_01");
  CHECK(scene->categories == std::vector<std::string>{"chair"});
  CHECK(scene->triangle_count() == 2);
  CHECK(same_box(scene->bounds(), {0, 0, 0}, {1, 1, 0}));

  REQUIRE(scene->textures.size() == 1);
  const wiw::scene::Texture& texture = scene->textures[0];
  CHECK(texture.size == wiw::Size{2, 2});
  const std::vector<int> expected{255, 0, 0, 255, 0, 255, 0, 255, 0, 0, 255, 255, 255, 255, 255, 255};
  CHECK(std::ranges::equal(texture.rgba, expected));
  // glTF counts v from the top, as the scene does: the vertex at the origin was written with (0, 1).
  const wiw::scene::Mesh& mesh = scene->meshes[0];
  for (std::size_t i = 0; i < mesh.positions.size(); ++i) {
    CHECK((mesh.uv[i] - Eigen::Vector2f(mesh.positions[i].x(), 1.f - mesh.positions[i].y())).norm() < 1e-6f);
  }
}

TEST_CASE("the up axis: option, HM3D names, COLLADA header") {
  const Folder folder;
  CHECK(same_box(load_mesh(folder.write("a.glb", sample_glb()), {.up = Up::kZ})->bounds(), {0, 0, -1}, {1, 0, 0}));
  const auto hm3d = load_mesh(folder.write("x.basis.glb", sample_glb()));
  CHECK(hm3d->attributes.at("up") == "Z (HM3D file layout)");
  CHECK(same_box(hm3d->bounds(), {0, 0, -1}, {1, 0, 0}));
  CHECK(same_box(load_mesh(folder.write("x.basis.glb", sample_glb()), {.up = Up::kY})->bounds(), {0, 0, 0}, {1, 1, 0}));

  const auto z_up = load_mesh(folder.write("z.dae", sample_dae()));
  CHECK(z_up->attributes.at("up") == "Z (by file header)");
  CHECK(same_box(z_up->bounds(), {0, 0, -1}, {1, 0, 0}));  // and 100 units of 0.01 m are 1 m
  const auto y_up = load_mesh(folder.write("y.dae", sample_dae("<up_axis>Y_UP</up_axis>")));
  CHECK(same_box(y_up->bounds(), {0, 0, 0}, {100, 100, 0}));
  const auto x_up = load_mesh(folder.write("x.dae", sample_dae("<up_axis>X_UP</up_axis>")));
  CHECK(same_box(x_up->bounds(), {-100, 0, 0}, {0, 100, 0}));  // x becomes y, y becomes -x
  CHECK(load_mesh(folder.write("d.dae", sample_dae("")))->attributes.at("up") == "Y (COLLADA default)");
  CHECK(load_mesh(folder.write("o.obj", sample_obj()))->attributes.at("up") == "Y (default, the file does not say)");
}

TEST_CASE("node transforms: rigid part in the pose, the rest in the vertices, meshes shared") {
  const Folder folder;
  GlbParts parts;
  parts.nodes =
      R"([{"children":[1,2,3],"translation":[10,0,0]},{"mesh":0,"name":"a","translation":[0,2,0]},)"
      R"({"mesh":0,"name":"b","rotation":[0,0.70710678,0,0.70710678]},{"mesh":0,"name":"c","scale":[2,-3,1]}])";
  const auto file = folder.write("nodes.glb", sample_glb(parts));
  const auto scene = load_mesh(file);
  REQUIRE(scene->instances.size() == 3);
  CHECK(scene->meshes.size() == 2);  // a and b share theirs
  CHECK(same_box(instance_bounds(*scene, scene->instances[0]), {10, 2, 0}, {11, 3, 0}));
  CHECK(same_box(instance_bounds(*scene, scene->instances[1]), {10, 0, -1}, {10, 1, 0}));  // x turns to -z
  CHECK(same_box(instance_bounds(*scene, scene->instances[2]), {10, -3, 0}, {12, 0, 0}));
  for (const wiw::scene::Instance& instance : scene->instances) {
    const Eigen::Matrix3f rotation = instance.T_world_instance.linear();
    CHECK((rotation * rotation.transpose()).isIdentity(1e-5f));
    CHECK(rotation.determinant() > 0.f);
    // A mirrored mesh keeps facing the way the mirror image of the square faces.
    const wiw::scene::Mesh& mesh = scene->meshes[instance.meshes[0]];
    const auto& t = mesh.triangles[0];
    const Eigen::Vector3f normal =
        (mesh.positions[t[1]] - mesh.positions[t[0]]).cross(mesh.positions[t[2]] - mesh.positions[t[0]]);
    const Eigen::Vector3f expected = instance.name == "b" ? Eigen::Vector3f::UnitX() : Eigen::Vector3f::UnitZ();
    CHECK((rotation * normal).normalized().isApprox(expected, 1e-4f));
  }

  // The same in Z-up axes: poses stay rigid, and the world is the turned one.
  const auto turned = load_mesh(file, {.up = Up::kZ});
  CHECK(same_box(instance_bounds(*turned, turned->instances[0]), {10, 0, -3}, {11, 0, -2}));
  CHECK(same_box(instance_bounds(*turned, turned->instances[2]), {10, 0, 0}, {12, 0, 3}));
}

TEST_CASE("colours: glTF factors are linear, OBJ and PLY are display-encoded") {
  const Folder folder;
  GlbParts parts;
  parts.material = R"({"pbrMetallicRoughness":{"baseColorFactor":[0.5,0,1,1]}})";
  const auto plain = load_mesh(folder.write("plain.glb", sample_glb(parts)));
  CHECK(material_of(*plain).texture == wiw::scene::kNone);
  CHECK(material_of(*plain).base_color.isApprox(Eigen::Vector4f(std::pow(0.5f, 1 / 2.2f), 0, 1, 1), 1e-5f));

  folder.write("sample.mtl", "newmtl wood\nKd 0.5 0.25 1\n");
  const auto obj = load_mesh(folder.write("plain.obj", sample_obj()));
  CHECK(material_of(*obj).base_color.isApprox(Eigen::Vector4f(0.5f, 0.25f, 1, 1), 1e-5f));
  CHECK(obj->categories == std::vector<std::string>{"table"});

  const auto ply = load_mesh(folder.write("colors.ply", sample_ply()));
  CHECK(ply->triangle_count() == 2);  // one quad
  REQUIRE(ply->meshes[0].colors.size() == 4);
  for (std::size_t i = 0; i < 4; ++i) {
    const auto& p = ply->meshes[0].positions[i];
    const int vertex = p.y() == 0.f ? (p.x() == 0.f ? 0 : 1) : (p.x() == 0.f ? 3 : 2);
    CHECK(ply->meshes[0].colors[i] ==
          Eigen::Matrix<std::uint8_t, 4, 1>(static_cast<std::uint8_t>(10 * vertex), 20, 255, 255));
  }
}

TEST_CASE("alpha counts only where the material says so") {
  const Folder folder;
  CHECK(material_of(*load_mesh(folder.write("opaque.glb", sample_glb()))).alpha_cutoff < 0.f);
  GlbParts parts;
  parts.material = R"({"alphaMode":"MASK","alphaCutoff":0.25,"pbrMetallicRoughness":{"baseColorTexture":{"index":0}}})";
  CHECK(material_of(*load_mesh(folder.write("mask.glb", sample_glb(parts)))).alpha_cutoff == doctest::Approx(0.25));
  parts.material = R"({"alphaMode":"BLEND","pbrMetallicRoughness":{"baseColorTexture":{"index":0}}})";
  CHECK(material_of(*load_mesh(folder.write("blend.glb", sample_glb(parts)))).alpha_cutoff == doctest::Approx(0.5));
}

TEST_CASE("external textures: beside the file, by base name, missing, undecodable") {
  const Folder folder;
  const auto file = folder.write("meshes/sample.obj", sample_obj());
  folder.write("meshes/sample.mtl", "newmtl wood\nKd 0.5 0.25 1\nmap_Kd C:\\art\\my%20photo.bmp\n");
  wiw::scene::ImportTrace trace;
  const auto missing = load_mesh(file, {.trace = &trace});
  REQUIRE(missing->warnings.size() == 1);
  CHECK(missing->warnings[0].find("my%20photo.bmp' of sample.obj was not found") != std::string::npos);
  CHECK(material_of(*missing).base_color.isApprox(Eigen::Vector4f(0.7f, 0.7f, 0.7f, 1.f)));
  const auto image = folder.path() / "meshes/../materials/textures/my photo.bmp";
  CHECK(std::ranges::find(trace.absent, image) != trace.absent.end());

  folder.write("materials/textures/my photo.bmp", sample_bmp());
  const auto found = load_mesh(file);
  CHECK(found->warnings.empty());
  CHECK(found->textures.size() == 1);
  CHECK(material_of(*found).base_color == Eigen::Vector4f::Ones());

  folder.write("materials/textures/my photo.bmp", "not an image");
  const auto damaged = load_mesh(file);
  REQUIRE(damaged->warnings.size() == 1);
  CHECK(damaged->warnings[0].find("cannot be decoded") != std::string::npos);
}

TEST_CASE("images in Basis Universal take a decoder, and are named where there is none") {
  const Folder folder;
  GlbParts parts;
  parts.texture = R"({"extensions":{"KHR_texture_basisu":{"source":0}}})";
  parts.image = sample_ktx2();
  const auto file = folder.write("x.basis.glb", sample_glb(parts));
  const auto grey = load_mesh(file);
  REQUIRE(grey->warnings.size() == 1);
  CHECK(grey->warnings[0].find("1 image of x.basis.glb is stored as Basis Universal") == 0);
  CHECK(grey->materials[0].texture_missing);
  const auto decode = [](const wiw::Size& size) {
    return [size](std::span<const std::uint8_t>) {
      return wiw::scene::Texture{"", size, std::vector<std::uint8_t>(4 * size.pixels(), 9), {}};
    };
  };
  const auto drawn = load_mesh(file, {.decode_basis = decode({2, 2})});
  CHECK(drawn->warnings.empty());
  REQUIRE(drawn->textures.size() == 1);
  CHECK(drawn->textures[0].rgba[0] == 9);
  const auto other = load_mesh(file, {.decode_basis = decode({2, 3})});
  REQUIRE(other->warnings.size() == 1);
  CHECK(other->warnings[0].find("another size than its header says") != std::string::npos);
}

TEST_CASE("glTF extensions that a file needs and nobody reads are refused") {
  const Folder folder;
  GlbParts parts;
  parts.material =
      R"({}],"extensionsUsed":["EXT_none"],"extensionsRequired" : ["KHR_texture_transform", "EXT_none"],"x":[0)";
  CHECK_THROWS_WITH_AS(load_mesh(folder.write("a.glb", sample_glb(parts))),
                       doctest::Contains("needs the glTF extension 'EXT_none'"), FileError);
  parts.material = R"({}],"extensionsRequired":["KHR_texture_transform","KHR_materials_unlit"],"x":[0)";
  CHECK(load_mesh(folder.write("b.glb", sample_glb(parts)))->triangle_count() == 2);
}

TEST_CASE("only the supported formats are read") {
  const Folder folder;
  const std::string stl =
      "solid s\nfacet normal 0 0 1\nouter loop\nvertex 0 0 0\nvertex 1 0 0\nvertex 0 1 0\nendloop\nendfacet\nendsolid "
      "s\n";
  CHECK_THROWS_WITH_AS(load_mesh(folder.write("a.stl", stl)), doctest::Contains(".glb, .gltf, .obj, .ply, .dae"),
                       FileError);
  CHECK_THROWS_AS(load_mesh(folder.write("a.obj", stl)), FileError);
  CHECK_THROWS_WITH_AS(load_mesh(folder.write("a.glb", sample_ply())),
                       doctest::Contains("does not begin like a binary glTF"), FileError);
  CHECK_THROWS_WITH_AS(load_mesh(folder.write("b.obj", sample_glb())),
                       doctest::Contains("does not begin like a Wavefront OBJ"), FileError);
  CHECK_THROWS_WITH_AS(load_mesh(folder.path() / "none.glb"), doctest::Contains("no such file"), FileError);
  CHECK_THROWS_WITH_AS(load_mesh(folder.write("empty.ply", "")), doctest::Contains("is empty"), FileError);
}

TEST_CASE("damage is named") {
  const Folder folder;
  GlbParts nan;
  nan.positions[4] = std::numeric_limits<float>::quiet_NaN();
  CHECK_THROWS_WITH_AS(load_mesh(folder.write("nan.glb", sample_glb(nan))), doctest::Contains("is not finite"),
                       FileError);
  GlbParts index;
  index.triangles[2] = 77;
  CHECK_THROWS_WITH_AS(load_mesh(folder.write("index.glb", sample_glb(index))),
                       doctest::Contains("mesh 0 has a triangle 0 that names vertex 77 of 4"), FileError);
  const std::string whole = sample_glb();
  CHECK_THROWS_WITH_AS(load_mesh(folder.write("cut.glb", whole.substr(0, whole.size() / 2))),
                       doctest::Contains("truncated"), FileError);
  GlbParts cycle;
  cycle.nodes = R"([{"mesh":0,"children":[1]},{"children":[0]}])";
  CHECK_THROWS_AS(load_mesh(folder.write("cycle.glb", sample_glb(cycle))), FileError);
}

TEST_CASE("triangles without area are dropped") {
  const Folder folder;
  GlbParts parts;
  parts.triangles = {0, 1, 2, 0, 0, 3, 0, 2, 3};
  CHECK(load_mesh(folder.write("a.glb", sample_glb(parts)))->triangle_count() == 2);
}

TEST_CASE("PLY elements come once, vertices first, with properties") {
  const Folder folder;
  const std::string vertices = "element vertex 3\nproperty float x\nproperty float y\nproperty float z\n";
  const std::string faces = "element face 1\nproperty list uchar int vertex_indices\n";
  const std::string body = "end_header\n0 0 0\n1 0 0\n0 1 0\n3 0 1 2\n";
  const auto ply = [&](const std::string& elements, const std::string& rows = "") {
    return folder.write("a.ply", "ply\nformat ascii 1.0\n" + elements + body + rows);
  };
  CHECK(load_mesh(ply(vertices + faces))->triangle_count() == 1);
  CHECK_THROWS_WITH_AS(load_mesh(ply(vertices + vertices + faces, "4 5 6\n7 8 9\n0 0 1\n")),
                       doctest::Contains("declares the element 'vertex' twice"), FileError);
  CHECK_THROWS_WITH_AS(load_mesh(ply(vertices + faces + faces, "3 0 1 2\n")),
                       doctest::Contains("declares the element 'face' twice"), FileError);
  CHECK_THROWS_WITH_AS(load_mesh(ply(faces + vertices)), doctest::Contains("no element 'vertex' before its faces"),
                       FileError);
  CHECK_THROWS_WITH_AS(load_mesh(ply("element vertex 3\n" + faces)), doctest::Contains("no property"), FileError);
}

TEST_CASE("rows and counts of a PLY file of text are checked before it is read") {
  const Folder folder;
  const auto ply = [&](const std::string& vertices, const std::string& faces, const std::string& rows,
                       const std::string& format = "ascii") {
    return folder.write("a.ply", "ply\nformat " + format + " 1.0\nelement vertex " + vertices +
                                     "\nproperty float x\nproperty float y\nproperty float z\nelement face " + faces +
                                     "\nproperty list uchar int vertex_indices\nend_header\n" + rows);
  };
  const std::string rows = "0 0 7\n1 0 7\n0 1 7\n3 0 1 2\n";
  CHECK(load_mesh(ply("3", "1", rows))->triangle_count() == 1);
  CHECK_THROWS_WITH_AS(load_mesh(ply("3", "1", "0 0 7\n1 0\n0 1 7\n3 0 1 2\n")),
                       doctest::Contains("vertex 1 has fewer entries than it says"), FileError);
  CHECK_THROWS_WITH_AS(load_mesh(ply("3", "2", rows)),
                       doctest::Contains("should have 2 rows of the element 'face' but has 1 left"), FileError);
  CHECK_THROWS_WITH_AS(load_mesh(ply("18446744073709551615", "2", rows)),
                       doctest::Contains("should have 18446744073709551615 rows of the element 'vertex'"), FileError);
  for (const char* format : {"ascii", "binary_little_endian"}) {
    for (const char* count : {"-1", "3x", "18446744073709551616", ""}) {
      CHECK_THROWS_WITH_AS(load_mesh(ply(count, "1", rows, format)),
                           doctest::Contains("an <element> line without name and count"), FileError);
    }
  }
}

TEST_CASE("transforms that overflow are the file's error") {
  const Folder folder;
  GlbParts parts;
  parts.positions = {0, 0, 0, 1e10f, 0, 0, 1e10f, 1e10f, 0, 0, 1e10f, 0};
  CHECK_THROWS_WITH_AS(load_mesh(folder.write("far.glb", sample_glb(parts))),
                       doctest::Contains("far.glb: 'Chair_01' reaches farther than 10^7"), FileError);
  parts.nodes = R"([{"mesh":0,"name":"Chair_01","scale":[1e30,1e30,1e30]}])";
  CHECK_THROWS_WITH_AS(load_mesh(folder.write("over.glb", sample_glb(parts))), doctest::Contains("over.glb: "),
                       FileError);
}

TEST_CASE("a node flattened to a plane is drawn, one squeezed to a line is named") {
  const Folder folder;
  GlbParts parts;
  parts.nodes = R"([{"mesh":0,"name":"flat","scale":[2,1,0]}])";
  const auto flat = load_mesh(folder.write("flat.glb", sample_glb(parts)));
  CHECK(flat->triangle_count() == 2);
  CHECK(same_box(flat->bounds(), {0, 0, 0}, {2, 1, 0}));
  parts.nodes = R"([{"mesh":0,"name":"flat"},{"mesh":0,"name":"line","scale":[2,0,0]}])";
  parts.scene_nodes = "[0,1]";
  const auto line = load_mesh(folder.write("line.glb", sample_glb(parts)));
  CHECK(line->instances.size() == 1);
  REQUIRE(line->warnings.size() == 1);
  CHECK(line->warnings[0].find("node 'line' is scaled to nothing") == 0);
}

TEST_CASE("normals survive every scale, and are left to the triangles where there is no inverse") {
  wiw::scene::Mesh mesh;
  mesh.positions = std::vector<Eigen::Vector3f>{{0, 0, 0}, {1, 0, 0}, {0, 1, 0}};
  mesh.normals = std::vector<Eigen::Vector3f>(3, Eigen::Vector3f(0.6f, 0, 0.8f));
  mesh.triangles = std::vector<Eigen::Matrix<std::uint32_t, 3, 1>>{{0, 1, 2}};
  const auto baked = [&](const Eigen::Vector3f& scale) {
    wiw::scene::Scene scene;
    wiw::scene::MeshBaker(scene).bake(mesh, Eigen::Affine3f(Eigen::Scaling(scale)), 0);
    return scene.meshes[0];
  };
  CHECK(baked({1, 1, 0}).normals.empty());
  CHECK(baked({1, 1, 1e-30f}).normals[0].isApprox(Eigen::Vector3f::UnitZ()));
  CHECK(baked({2, 1, 1}).normals[0].isApprox(Eigen::Vector3f(0.3f, 0, 0.8f).normalized()));
  CHECK(baked({-1, 1, 1}).normals[0].isApprox(Eigen::Vector3f(-0.6f, 0, 0.8f)));
}

TEST_CASE("textures are summed by their headers before any is decoded") {
  const Folder folder;
  folder.write("huge.bmp", sample_bmp(4096));
  folder.write("sample.mtl", "newmtl wood\nmap_Kd huge.bmp\n");
  const auto file = folder.write("a.obj", sample_obj());
  CHECK_THROWS_WITH_AS(load_mesh(file, {.limits = {.texture_bytes = 67'108'863}}),
                       doctest::Contains("has 67108864 bytes of decoded textures, more than"), FileError);
}

TEST_CASE("limits are enforced by figure and name") {
  const Folder folder;
  const auto file = folder.write("a.glb", sample_glb());
  const auto refused = [&](const wiw::scene::ImportLimits& limits, const char* text) {
    CHECK_THROWS_WITH_AS(load_mesh(file, {.limits = limits}), doctest::Contains(text), FileError);
  };
  refused({.file_bytes = 100}, "more than the limit of 100 (raise limits.file_bytes");
  refused({.triangles = 1}, "has 2 triangles, more than the limit of 1 (raise limits.triangles");
  refused({.nodes = 0}, "limits.nodes");
  refused({.texture_bytes = 15}, "has 16 bytes of decoded textures");
  const auto scene = load_mesh(file, {.limits = {.texture_pixels = 3}});
  REQUIRE(scene->warnings.size() == 1);
  CHECK(scene->warnings[0].find("2 x 2 pixels, more than the limit of 3") != std::string::npos);
}

TEST_CASE("a ceiling closes a scene and faces down") {
  const Folder folder;
  const auto scene = load_mesh(folder.write("a.obj", "o floor\nv 0 1 0\nv 4 1 0\nv 4 1 3\nv 0 1 3\nf 4 3 2 1\n"),
                               {.ceiling_height = 2.5f});
  REQUIRE(scene->instances.size() == 2);
  const wiw::scene::Instance& ceiling = scene->instances[1];
  CHECK(ceiling.name == "ceiling");
  CHECK(scene->categories[static_cast<std::size_t>(ceiling.category)] == "ceiling");
  CHECK(same_box(instance_bounds(*scene, ceiling), {0, 3.5f, 0}, {4, 3.5f, 3}));
  const wiw::scene::Mesh& mesh = scene->meshes[ceiling.meshes[0]];
  for (const auto& t : mesh.triangles) {
    CHECK((mesh.positions[t[1]] - mesh.positions[t[0]]).cross(mesh.positions[t[2]] - mesh.positions[t[0]]).y() < 0.f);
  }
  CHECK_THROWS_AS(load_mesh(folder.path() / "a.obj", {.ceiling_height = -1.f}), wiw::ArgumentError);
}
