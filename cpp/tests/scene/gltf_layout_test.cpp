// SPDX-License-Identifier: Apache-2.0
#include "wiw/scene/import/gltf_layout.hpp"

#include <doctest/doctest.h>

#include "scene/samples.hpp"
#include "wiw/core/error.hpp"
#include "wiw/scene/import.hpp"
#include "wiw/scene/import/json.hpp"

namespace {

/// A triangle: three vertices of three floats in 36 bytes, with what a test puts in place of its parts.
struct Gltf {
  std::string version = R"("2.0")";
  std::string primitive = R"({"attributes":{"POSITION":0}})";
  std::string accessors = R"([{"bufferView":0,"componentType":5126,"count":3,"type":"VEC3"}])";
  std::string views = R"([{"buffer":0,"byteLength":36}])";
  std::string more;

  [[nodiscard]] std::string text() const {
    return R"({"asset":{"version":)" + version +
           R"(},"scene":0,"scenes":[{"nodes":[0]}],"nodes":[{"mesh":0,"name":"n"}],"meshes":[{"primitives":[)" +
           primitive + R"(]}],"accessors":)" + accessors + R"(,"bufferViews":)" + views + more +
           R"(,"buffers":[{"byteLength":36,"uri":"data.bin"}]})";
  }
};

void check_layout(const Gltf& gltf) {
  wiw::scene::check_gltf_layout(wiw::scene::Json::parse(gltf.text()), std::nullopt, "a.gltf");
}

void refused(const Gltf& gltf, const char* cause) {
  CAPTURE(gltf.text());
  CHECK_THROWS_WITH_AS(check_layout(gltf), doctest::Contains(cause), wiw::FileError);
}

std::string accessor(const std::string& fields) { return R"([{"componentType":5126,"type":"VEC3",)" + fields + "}]"; }

void write_triangle(const Folder& folder) {
  std::string bytes;
  for (const float value : {0.f, 0.f, 0.f, 1.f, 0.f, 0.f, 0.f, 1.f, 0.f}) append(bytes, value);
  folder.write("data.bin", bytes);
}

}  // namespace

TEST_CASE("JSON is read as it is written") {
  const wiw::scene::Json json = wiw::scene::Json::parse(
      " {\"a\": [1, -2, 3.5, 1e3, 18446744073709551615, true, null], \"b\\u0041\\n\": \"\\ud83d\\ude00\\\\\","
      "\"a\": 2, \"c\": {}, \"d\": []} ");
  const auto& a = json["a"].items();
  REQUIRE(a.size() == 7);
  CHECK(a[0].whole() == 1U);
  for (const std::size_t i : {1U, 2U, 3U, 5U, 6U}) CHECK_FALSE(a[i].whole().has_value());
  CHECK(a[4].whole() == UINT64_MAX);
  CHECK(a[6].is_null());
  CHECK_FALSE(a[5].is_null());
  CHECK(json["bA\n"].text() == "\xF0\x9F\x98\x80\\");
  CHECK(json["c"].is_object());
  CHECK(json["none"].is_null());
  CHECK(json["a"]["b"].is_null());
  CHECK(wiw::scene::Json::parse(std::string("1\0 junk", 7)).whole() == 1U);
  for (const char* text : {"", "{", "[1,]", "{\"a\"}", "\"a", "\"\\x\"", "\"\\u12\"", "\"\\ud800\"", "tru", "1 2"}) {
    CAPTURE(text);
    CHECK_THROWS_WITH_AS(wiw::scene::Json::parse(text), doctest::Contains("is no valid JSON"), wiw::Error);
  }
  CHECK_THROWS_WITH_AS(wiw::scene::Json::parse(std::string(100'000, '[')), doctest::Contains("nested"), wiw::Error);
}

TEST_CASE("glTF accessors and views must lie inside what they read") {
  CHECK_NOTHROW(check_layout({}));
  const std::string in_view = R"("bufferView":0,)";
  refused({.accessors = accessor(in_view + R"("count":4)")}, "reads 4 elements, 12 bytes apart, from byte 0 of");
  refused({.accessors = accessor(in_view + R"("count":3,"byteOffset":1)")}, "from byte 1 of a bufferView of 36");
  refused({.accessors = accessor(in_view + R"("count":18446744073709551615,"byteOffset":12)")}, "reads");
  refused({.accessors = accessor(in_view + R"("count":1,"byteOffset":18446744073709551615)")}, "reads");
  refused({.accessors = accessor(in_view + R"("count":-3)")}, "'count' that is no whole number");
  refused({.accessors = accessor(R"("bufferView":1,"count":3)")}, "names bufferView 1 of 1");
  refused({.accessors = R"([{"bufferView":0,"componentType":5124,"count":1,"type":"VEC3"}])"}, "unknown type");
  refused({.accessors = R"([{"bufferView":0,"componentType":5126,"count":1,"type":"VEC5"}])"}, "unknown type");
  refused({.views = R"([{"buffer":0,"byteLength":36,"byteOffset":4}])"}, "has 36 bytes from 4, but its buffer 36");
  refused({.views = R"([{"buffer":0,"byteLength":18446744073709551615,"byteOffset":4}])"}, "but its buffer 36");
  refused({.views = R"([{"buffer":1,"byteLength":36}])"}, "names buffer 1 of 1");

  const std::string strided = R"([{"buffer":0,"byteLength":36,"byteStride":24}])";
  CHECK_NOTHROW(check_layout({.accessors = accessor(in_view + R"("count":2)"), .views = strided}));
  refused({.accessors = accessor(in_view + R"("count":2,"byteOffset":1)"), .views = strided}, "24 bytes apart");
  refused({.accessors = accessor(in_view + R"("count":3)"), .views = strided}, "24 bytes apart");
  // A stride below the element's size must not hide that the last element ends outside.
  refused(
      {.accessors = accessor(in_view + R"("count":9)"), .views = R"([{"buffer":0,"byteLength":36,"byteStride":1}])"},
      "12 bytes apart");
}

TEST_CASE("sparse glTF accessors must lie inside their two views") {
  const auto sparse = [](const std::string& indices, const std::string& values) {
    return Gltf{.accessors = accessor(R"("count":3,"bufferView":0,"sparse":{"count":2,"indices":{"bufferView":1,)" +
                                      indices + R"(},"values":{"bufferView":0,)" + values + "}}"),
                .views = R"([{"buffer":0,"byteLength":36},{"buffer":0,"byteLength":4}])"};
  };
  CHECK_NOTHROW(check_layout(sparse(R"("componentType":5123)", R"("byteOffset":12)")));
  refused(sparse(R"("componentType":5125)", R"("byteOffset":12)"), "reads 2 elements, 4 bytes apart");
  refused(sparse(R"("componentType":5123)", R"("byteOffset":13)"), "reads 2 elements, 12 bytes apart");
}

TEST_CASE("glTF accessors that are read side by side are as long as each other") {
  const std::string two =
      R"([{"bufferView":0,"componentType":5126,"count":3,"type":"VEC3"},{"bufferView":0,"componentType":5126,"count":2,"type":"VEC3"}])";
  refused({.primitive = R"({"attributes":{"POSITION":0,"NORMAL":1}})", .accessors = two}, "for");
  refused({.primitive = R"({"attributes":{"POSITION":0},"targets":[{"POSITION":1}]})", .accessors = two},
          "2 values of POSITION for 3 vertices");
  refused({.primitive = R"({"attributes":{"POSITION":0},"indices":2})", .accessors = two}, "names indices 2 of 2");
  refused({.accessors = two, .more = R"(,"skins":[{"inverseBindMatrices":1,"joints":[0,0,0]}])"},
          "2 matrices for 3 joints");
}

TEST_CASE("damage in animations, which are not read, does not matter") {
  CHECK_NOTHROW(check_layout(Gltf{.more = R"(,"animations":[{"channels":[],"samplers":[{"input":7,"output":9}]}])"}));
}

TEST_CASE("glTF files with accessors beyond their views are refused before they are read") {
  const Folder folder;
  write_triangle(folder);
  CHECK(wiw::scene::load_mesh(folder.write("whole.gltf", Gltf{}.text()))->triangle_count() == 1);
  const Gltf beyond{.accessors = accessor(R"("bufferView":0,"count":3,"byteOffset":24)")};
  CHECK_THROWS_WITH_AS(wiw::scene::load_mesh(folder.write("beyond.gltf", beyond.text())),
                       doctest::Contains("beyond.gltf: accessor 0 reads 3 elements"), wiw::FileError);
  const Gltf older{.version = R"("1.0")"};
  CHECK_THROWS_WITH_AS(wiw::scene::load_mesh(folder.write("older.gltf", older.text())),
                       doctest::Contains("only version 2 is supported"), wiw::FileError);

  const std::string whole = sample_glb();
  std::string beyond_body = whole;  // the views' buffer is the binary chunk, whatever the JSON says of its length
  const std::string view = R"("byteOffset":48,"byteLength":32)";
  const std::size_t at = beyond_body.find(view);
  REQUIRE(at != std::string::npos);
  beyond_body.replace(at, view.size(), R"("byteOffset":99,"byteLength":99)");
  CHECK_THROWS_WITH_AS(wiw::scene::load_mesh(folder.write("body.glb", beyond_body)),
                       doctest::Contains("bufferView 1 has 99 bytes"), wiw::FileError);
}

TEST_CASE("accessors without any data are refused, not followed") {
  const Folder folder;
  write_triangle(folder);
  const Gltf empty{.primitive = R"({"attributes":{"POSITION":0},"indices":1})",
                   .accessors = R"([{"bufferView":0,"componentType":5126,"count":3,"type":"VEC3"},)"
                                R"({"componentType":5125,"count":3,"type":"SCALAR"}])"};
  CHECK_THROWS_AS(wiw::scene::load_mesh(folder.write("empty.gltf", empty.text())), wiw::FileError);
}
