// SPDX-License-Identifier: Apache-2.0
#include "wiw/scene/cache.hpp"

#include <doctest/doctest.h>
#include <sys/syscall.h>
#include <unistd.h>

#include <algorithm>
#include <filesystem>
#include <regex>
#include <set>
#include <span>

#include "scene/samples.hpp"
#include "wiw/core/error.hpp"
#include "wiw/core/rng.hpp"
#include "wiw/scene/cache/header.hpp"
#include "wiw/scene/import.hpp"

namespace {

template <class T>
bool same(const wiw::Buffer<T>& a, const wiw::Buffer<T>& b) {
  return a.size() == b.size() && std::equal(a.begin(), a.end(), b.begin());
}

/// A call of fsync: on what, and whether the watched file had its name by then.
struct Sync {
  std::string path;
  std::uintmax_t bytes;
  bool named;
};
std::vector<Sync> syncs;
std::filesystem::path watched;

/// Which bytes of a mapped file are geometry; the texture's are the first, behind the header.
std::vector<bool> bytes_of_geometry(const wiw::scene::Scene& scene, std::size_t file_bytes) {
  const std::uint8_t* begin = scene.textures[0].rgba.data() - 64;
  std::vector<bool> inside(file_bytes);
  const auto mark = [&](const auto& buffer) {
    const auto bytes = std::as_bytes(std::span(buffer.data(), buffer.size()));
    const auto first = reinterpret_cast<const std::uint8_t*>(bytes.data()) - begin;
    for (std::size_t i = 0; i < bytes.size(); ++i) inside.at(static_cast<std::size_t>(first) + i) = true;
  };
  const wiw::scene::Mesh& mesh = scene.meshes[0];
  mark(mesh.positions);
  mark(mesh.normals);
  mark(mesh.uv);
  mark(mesh.lightmap_uv);
  mark(mesh.colors);
  mark(mesh.triangles);
  return inside;
}

/// A scene that uses every field.
wiw::scene::Scene full_scene() {
  wiw::scene::Scene scene;
  scene.name = "full";
  scene.textures = {{"stripes", {1, 2}, std::vector<std::uint8_t>{1, 2, 3, 4, 5, 6, 7, 8}}};
  scene.materials = {{"wood", {0.1f, 0.2f, 0.3f, 0.4f}, 0, 0.5f, true}, {"plain"}};
  wiw::scene::Mesh mesh;
  mesh.positions = std::vector<Eigen::Vector3f>{{0, 0, 0}, {1, 0, 0}, {0, 1, 0}};
  mesh.normals = std::vector<Eigen::Vector3f>(3, Eigen::Vector3f::UnitZ());
  mesh.uv = std::vector<Eigen::Vector2f>{{0, 0}, {1, 0}, {0, 1}};
  mesh.lightmap_uv = std::vector<Eigen::Vector2f>{{0.5f, 0}, {1, 0.5f}, {0, 1}};
  mesh.colors = std::vector<Eigen::Matrix<std::uint8_t, 4, 1>>(3, {9, 8, 7, 6});
  mesh.triangles = std::vector<Eigen::Matrix<std::uint32_t, 3, 1>>{{0, 1, 2}};
  mesh.material = 1;
  mesh.lightmap = 0;
  scene.meshes = {mesh, {}};
  scene.categories = {"chair"};
  wiw::scene::Instance instance{
      1, "a chair", 0, {0, 1}, Eigen::Affine3f(Eigen::Translation3f(1, 2, 3)), {{"color", "red"}}};
  scene.instances = {instance, {2, "none"}};
  scene.rooms = {{"kitchen 1", "kitchen", Eigen::AlignedBox3f(Eigen::Vector3f(0, 1, 2), Eigen::Vector3f(3, 4, 5))}};
  scene.sky.zenith = {1, 0, 0.5f};
  scene.sun = {{0.6f, 0, 0.8f}, 0.25f, 0.75f};
  scene.attributes = {{"up", "Y"}, {"split", "val"}};
  scene.warnings = {"something is missing"};
  return scene;
}

std::string bytes_of(const std::filesystem::path& file) {
  std::ifstream stream(file, std::ios::binary);
  return {std::istreambuf_iterator<char>(stream), {}};
}

}  // namespace

/// In place of the C library's: notes the call and passes it on.
extern "C" int fsync(int file) {
  const auto path = std::filesystem::read_symlink("/proc/self/fd/" + std::to_string(file));
  std::error_code is_folder;
  const auto bytes = std::filesystem::file_size(path, is_folder);
  syncs.push_back({path.string(), is_folder ? 0 : bytes, std::filesystem::exists(watched)});
  return static_cast<int>(syscall(SYS_fsync, file));
}

TEST_CASE("a scene comes back from its cache as it was") {
  const Folder folder;
  const wiw::scene::Scene scene = full_scene();
  const auto file = folder.path() / "scene.wiwscene";
  wiw::scene::write_scene_cache(scene, file);
  const wiw::scene::ScenePtr mapped = wiw::scene::map_scene_cache(file);
  CHECK(std::distance(std::filesystem::directory_iterator(folder.path()), {}) == 1);  // no draft is left
  std::filesystem::remove(file);                                                      // the mapping lives on

  CHECK(mapped->name == scene.name);
  REQUIRE(mapped->textures.size() == 1);
  CHECK(mapped->textures[0].name == "stripes");
  CHECK(mapped->textures[0].size == wiw::Size{1, 2});
  CHECK(same(mapped->textures[0].rgba, scene.textures[0].rgba));
  REQUIRE(mapped->materials.size() == 2);
  CHECK(mapped->materials[0].base_color == scene.materials[0].base_color);
  CHECK(mapped->materials[0].alpha_cutoff == 0.5f);
  CHECK(mapped->materials[0].emissive);
  CHECK(mapped->materials[0].texture == 0);
  CHECK(mapped->materials[1].texture == wiw::scene::kNone);
  REQUIRE(mapped->meshes.size() == 2);
  CHECK(same(mapped->meshes[0].positions, scene.meshes[0].positions));
  CHECK(same(mapped->meshes[0].normals, scene.meshes[0].normals));
  CHECK(same(mapped->meshes[0].uv, scene.meshes[0].uv));
  CHECK(same(mapped->meshes[0].lightmap_uv, scene.meshes[0].lightmap_uv));
  CHECK(same(mapped->meshes[0].colors, scene.meshes[0].colors));
  CHECK(same(mapped->meshes[0].triangles, scene.meshes[0].triangles));
  CHECK(mapped->meshes[0].material == 1);
  CHECK(mapped->meshes[0].lightmap == 0);
  CHECK(mapped->meshes[1].positions.empty());
  REQUIRE(mapped->instances.size() == 2);
  CHECK(mapped->instances[0].name == "a chair");
  CHECK(mapped->instances[0].category == 0);
  CHECK(mapped->instances[0].meshes == std::vector<std::uint32_t>{0, 1});
  CHECK(mapped->instances[0].T_world_instance.matrix() == scene.instances[0].T_world_instance.matrix());
  CHECK(mapped->instances[0].attributes == scene.instances[0].attributes);
  CHECK(mapped->rooms[0].bounds.isApprox(scene.rooms[0].bounds));
  CHECK(mapped->rooms[0].type == "kitchen");
  CHECK(mapped->sky.zenith == scene.sky.zenith);
  CHECK(mapped->sky.horizon == scene.sky.horizon);
  CHECK(mapped->sun.has_value());
  const wiw::scene::Sun sun = mapped->sun.value_or(wiw::scene::Sun{});
  CHECK(sun.direction == Eigen::Vector3f(0.6f, 0, 0.8f));
  CHECK(sun.strength == 0.25f);
  CHECK(sun.ambient == 0.75f);
  CHECK(mapped->categories == scene.categories);
  CHECK(mapped->attributes == scene.attributes);
  CHECK(mapped->warnings == scene.warnings);
}

TEST_CASE("a scene without a sun comes back without one") {
  const Folder folder;
  wiw::scene::Scene scene = full_scene();
  scene.sun.reset();
  wiw::scene::write_scene_cache(scene, folder.path() / "scene.wiwscene");
  CHECK_FALSE(wiw::scene::map_scene_cache(folder.path() / "scene.wiwscene")->sun.has_value());
}

TEST_CASE("arrays of a cache are aligned views of one mapping") {
  const Folder folder;
  const auto file = folder.path() / "scene.wiwscene";
  wiw::scene::write_scene_cache(full_scene(), file);
  const wiw::scene::ScenePtr mapped = wiw::scene::map_scene_cache(file);
  const auto address = [](const void* pointer) { return reinterpret_cast<std::uintptr_t>(pointer); };
  const std::uintptr_t first = address(mapped->textures[0].rgba.data());
  for (const std::uintptr_t array :
       {first, address(mapped->meshes[0].positions.data()), address(mapped->meshes[0].triangles.data())}) {
    CHECK(array % 64 == 0);
    CHECK(array / 4096 == first / 4096);  // the file is smaller than a page
  }
}

TEST_CASE("damaged, cut and foreign caches are refused") {
  const Folder folder;
  const auto file = folder.path() / "scene.wiwscene";
  wiw::scene::write_scene_cache(full_scene(), file);
  const std::string whole = bytes_of(file);
  CHECK_THROWS_AS(wiw::scene::map_scene_cache(folder.path() / "none"), wiw::FileError);
  CHECK_THROWS_AS(wiw::scene::map_scene_cache(folder.write("empty", "")), wiw::FileError);
  CHECK_THROWS_WITH_AS(wiw::scene::map_scene_cache(folder.write("text", std::string(500, 'x'))),
                       doctest::Contains("no scene cache"), wiw::FileError);
  std::string older = whole;
  older[8] = 0;
  CHECK_THROWS_WITH_AS(wiw::scene::map_scene_cache(folder.write("older", older)),
                       doctest::Contains("has version 0, expected 5"), wiw::FileError);
  for (std::size_t length = 1; length < whole.size(); length += 7) {
    CHECK_THROWS_AS(wiw::scene::map_scene_cache(folder.write("cut", whole.substr(0, length))), wiw::FileError);
  }
  std::uint64_t table = 0;
  std::memcpy(&table, whole.data() + 24, sizeof(table));
  const std::vector<bool> geometry = bytes_of_geometry(*wiw::scene::map_scene_cache(file), whole.size());
  for (std::size_t bit = 0; bit < 8 * whole.size(); bit += 37) {
    const std::size_t at = bit / 8;
    std::string flipped = whole;
    flipped[at] = static_cast<char>(flipped[at] ^ (1 << (bit % 8)));
    const auto damaged = folder.write("flipped", flipped);
    if (at < 64 || at >= table || geometry[at]) {
      CHECK_THROWS_WITH_AS(wiw::scene::map_scene_cache(damaged), doctest::Contains("flipped"), wiw::FileError);
    } else {  // texels, and what fills up to the next 64 bytes
      CHECK_NOTHROW(wiw::scene::map_scene_cache(damaged));
    }
  }
}

TEST_CASE("the checksum of an array sees every bit, the length and the order") {
  std::vector<std::uint8_t> bytes(200);
  for (std::size_t i = 0; i < bytes.size(); ++i) bytes[i] = static_cast<std::uint8_t>(i * i);
  std::set<std::uint64_t> seen;
  for (std::size_t length = 0; length < bytes.size(); ++length) {
    seen.insert(wiw::scene::cache::array_checksum(std::span(bytes).first(length)));
  }
  for (std::size_t bit = 0; bit < 8 * bytes.size(); ++bit) {
    bytes[bit / 8] ^= static_cast<std::uint8_t>(1U << (bit % 8));
    seen.insert(wiw::scene::cache::array_checksum(bytes));
    bytes[bit / 8] ^= static_cast<std::uint8_t>(1U << (bit % 8));
  }
  std::swap_ranges(bytes.begin(), bytes.begin() + 64, bytes.begin() + 64);
  seen.insert(wiw::scene::cache::array_checksum(bytes));
  CHECK(seen.size() == 200 + 8 * 200 + 1);
  CHECK(wiw::scene::cache::array_checksum({}) != wiw::scene::cache::array_checksum(std::vector<std::uint8_t>(64)));
}

TEST_CASE("a cache is on the disk before it has its name, and its name after") {
  const Folder folder;
  const auto file = folder.path() / "scene.wiwscene";
  syncs.clear();
  watched = file;
  wiw::scene::write_scene_cache(full_scene(), file);
  REQUIRE(syncs.size() == 2);
  CHECK(syncs[0].path.starts_with(file.string() + "."));
  CHECK_FALSE(syncs[0].named);
  CHECK(syncs[0].bytes == std::filesystem::file_size(file));
  CHECK(syncs[1].path == folder.path().string());
  CHECK(syncs[1].named);
}

TEST_CASE("a cache that cannot be written says so") {
  CHECK_THROWS_AS(wiw::scene::write_scene_cache(full_scene(), "/nonexistent/folder/scene.wiwscene"), wiw::FileError);
}

TEST_CASE("drafts have random bits in their names, for writers on machines that share the folder") {
  const Folder folder;
  const auto file = folder.path() / "scene.wiwscene";
  std::set<std::string> seen;
  for (int i = 0; i < 2; ++i) {
    syncs.clear();
    wiw::scene::write_scene_cache(full_scene(), file);
    REQUIRE_FALSE(syncs.empty());
    const std::string name = syncs[0].path.substr(file.string().size());
    std::smatch parts;
    REQUIRE(std::regex_match(name, parts, std::regex(R"(\.\d+-\d+-(\d+)\.tmp)")));
    seen.insert(parts[1].str());
  }
  CHECK(seen.size() == 2);
}
