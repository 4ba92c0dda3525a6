// SPDX-License-Identifier: Apache-2.0
#include <DetourNavMesh.h>
#include <doctest/doctest.h>
#include <unistd.h>

#include <cmath>
#include <cstring>
#include <filesystem>
#include <fstream>
#include <iterator>
#include <limits>

#include "nav/rooms.hpp"
#include "wiw/core/error.hpp"
#include "wiw/core/rng.hpp"
#include "wiw/nav/distance_field.hpp"
#include "wiw/nav/nav_mesh.hpp"
#include "wiw/nav/navmesh_file.hpp"

using namespace wiw;
using namespace wiw::nav;
using Eigen::Vector3f;
using Bytes = std::vector<char>;

namespace {

std::string scratch_file(const char* name) {
  return (std::filesystem::temp_directory_path() / ("wiw_nav_" + std::to_string(::getpid()) + name)).string();
}

Bytes read_all(const std::string& path) {
  std::ifstream stream(path, std::ios::binary);
  return {std::istreambuf_iterator<char>(stream), {}};
}

void write_all(const std::string& path, const Bytes& bytes) {
  std::ofstream(path, std::ios::binary | std::ios::trunc)
      .write(bytes.data(), static_cast<std::streamsize>(bytes.size()));
}

std::shared_ptr<NavMesh> two_blocks() {
  test::Soup soup;
  soup.floor(0, 0, 6, 5);
  soup.block(2, 1, 3, 4);
  soup.block(4, 0, 4.5f, 3);
  return NavMesh::from_triangles(soup.vertices, soup.triangles);
}

/// Replaces a few bytes or words with small, huge, negative or random values, or cuts the file short.
Bytes damage(Bytes bytes, Rng& rng) {
  if (rng.chance(0.1)) bytes.resize(rng.below(static_cast<std::uint32_t>(bytes.size())));
  constexpr std::uint32_t kWords[] = {0, 1, 0x7FFFFFFF, 0xFFFFFFFF, 0x80000000, 0x7FC00000, 0x7F800000, 0xFFFF};
  const std::uint32_t edits = 1 + rng.below(4);
  for (std::uint32_t k = 0; k < edits && bytes.size() >= 4; ++k) {
    const std::uint32_t at = rng.below(static_cast<std::uint32_t>(bytes.size() - 3));
    const std::uint32_t word = rng.chance(0.5) ? kWords[rng.below(8)] : rng();
    std::memcpy(bytes.data() + at, &word, rng.chance(0.5) ? 4 : 1);
  }
  return bytes;
}

/// An array of the tile: its count in the tile's header, and the bytes of one element.
struct Array {
  int dtMeshHeader::* count;
  std::size_t size;
};
const std::vector<Array> kArrays{
    {&dtMeshHeader::vertCount, 3 * sizeof(float)},       {&dtMeshHeader::polyCount, sizeof(dtPoly)},
    {&dtMeshHeader::maxLinkCount, sizeof(dtLink)},       {&dtMeshHeader::detailMeshCount, sizeof(dtPolyDetail)},
    {&dtMeshHeader::detailVertCount, 3 * sizeof(float)}, {&dtMeshHeader::detailTriCount, 4},
    {&dtMeshHeader::bvNodeCount, sizeof(dtBVNode)},      {&dtMeshHeader::offMeshConCount, sizeof(dtOffMeshConnection)}};

/// A file of version 1 as its parts, so that an array can change its length and everything behind it moves.
class TileFile {
 public:
  explicit TileFile(const Bytes& file) : front_(file.begin(), file.begin() + kTileAt) {
    std::memcpy(&header, file.data() + kTileAt, sizeof header);
    auto at = file.begin() + kTileAt + sizeof(dtMeshHeader);
    for (const Array& array : kArrays) {
      const auto bytes = static_cast<std::ptrdiff_t>(static_cast<std::size_t>(header.*array.count) * array.size);
      arrays_.emplace_back(at, at + bytes);
      at += bytes;
    }
    REQUIRE(at == file.end());
  }

  /// Cuts an array, or appends zeros to it.
  void resize(std::size_t array, int count) {
    header.*kArrays[array].count = count;
    arrays_[array].resize(static_cast<std::size_t>(count) * kArrays[array].size);
  }

  [[nodiscard]] Bytes bytes() const {
    Bytes tile(sizeof header);
    std::memcpy(tile.data(), &header, sizeof header);
    for (const Bytes& array : arrays_) tile.insert(tile.end(), array.begin(), array.end());
    Bytes file = front_;
    const auto size = static_cast<std::int32_t>(tile.size());
    std::memcpy(file.data() + kTileAt - sizeof size, &size, sizeof size);
    file.insert(file.end(), tile.begin(), tile.end());
    return file;
  }

  /// Sides that two polygons share.
  [[nodiscard]] int shared_sides() const {
    int sides = 0;
    for (std::size_t at = 0; at < arrays_[1].size(); at += sizeof(dtPoly)) {
      dtPoly polygon;
      std::memcpy(&polygon, arrays_[1].data() + at, sizeof polygon);
      for (int k = 0; k < polygon.vertCount; ++k) sides += polygon.neis[k] != 0;
    }
    return sides;
  }

  [[nodiscard]] dtPoly polygon(int index) const {
    dtPoly polygon;
    std::memcpy(&polygon, arrays_[1].data() + static_cast<std::size_t>(index) * sizeof(dtPoly), sizeof polygon);
    return polygon;
  }
  void set_polygon(int index, const dtPoly& polygon) {
    std::memcpy(arrays_[1].data() + static_cast<std::size_t>(index) * sizeof(dtPoly), &polygon, sizeof polygon);
  }

  dtMeshHeader header{};

 private:
  static constexpr std::ptrdiff_t kTileAt = 48;  // behind the header of the file and the tile's reference and size
  Bytes front_;
  std::vector<Bytes> arrays_;
};

/// Asks everything that follows indices of the file.
void use(const NavMesh& mesh) {
  const auto points = mesh.sample(6, 1, -1);
  for (const Metric metric : {Metric::kExact, Metric::kDetour, Metric::kDetourUncapped}) {
    (void)mesh.distance_matrix(points, metric);
  }
  for (const Vector3f& point : points) {
    (void)mesh.try_step(point, points[0], true);
    (void)mesh.try_step(point, points[0], false);
    (void)mesh.is_navigable(point);
  }
}

}  // namespace

TEST_CASE("a damaged file is refused with its name, or what is left of it can be used safely") {
  const std::string path = scratch_file("fuzz.navmesh");
  const auto good = two_blocks();
  Rng rng(20);
  int refused = 0;
  for (const int version : {1, 2}) {
    good->save(path, version);
    const Bytes bytes = read_all(path);
    for (int i = 0; i < 1500; ++i) {
      write_all(path, damage(bytes, rng));
      try {
        use(*NavMesh::load(path));
      } catch (const FileError& error) {
        ++refused;
        CHECK(std::string(error.what()).starts_with(path));
      }
    }
  }
  CHECK(refused > 500);
  std::filesystem::remove(path);
}

TEST_CASE("a file whose counts and length agree on too much or too little is refused, or can be used safely") {
  const std::string path = scratch_file("counts.navmesh");
  two_blocks()->save(path, 1);
  const TileFile good(read_all(path));
  const auto usable = [&](const TileFile& file) {
    write_all(path, file.bytes());
    try {
      use(*NavMesh::load(path));
      return true;
    } catch (const FileError& error) {
      CHECK(std::string(error.what()).starts_with(path));
      return false;
    }
  };
  REQUIRE(usable(good));
  int refused = 0;
  for (std::size_t array = 0; array < kArrays.size(); ++array) {
    const int count = good.header.*kArrays[array].count;
    for (const int wrong : {0, 1, count / 2, count - 1, count + 1, 2 * count + 7}) {
      if (wrong < 0) continue;
      TileFile file = good;
      file.resize(array, wrong);
      refused += !usable(file);
      file.resize(1, wrong);  // polygons and their height detail, which must be as many
      file.resize(3, wrong);
      refused += !usable(file);
    }
  }
  CHECK(refused > 60);

  const int needed = good.shared_sides();
  REQUIRE(needed > 4);
  for (const int links : {0, 1, needed - 1, needed, needed + 1}) {
    TileFile file = good;
    file.resize(2, links);
    CAPTURE(links);
    CHECK(usable(file) == (links >= needed));
  }
  std::filesystem::remove(path);
}

TEST_CASE("every field of the settings survives the file") {
  test::Soup soup;
  soup.floor(0, 0, 6, 5);
  NavMeshSettings settings;
  settings.cell_size = 0.06f;
  settings.agent_radius = 0.2f;
  settings.edge_max_error = 1.1f;
  settings.detail_sample_distance = 4;
  settings.filter_ledge_spans = false;
  settings.include_static_objects = true;
  const std::string path = scratch_file("settings.navmesh");
  const auto mesh = NavMesh::from_triangles(soup.vertices, soup.triangles, settings);
  mesh->save(path);
  CHECK(NavMesh::load(path)->settings() == settings);
  mesh->save(path, 1);
  const NavMeshSettings derived = NavMesh::load(path)->settings();
  CHECK(derived.agent_radius == settings.agent_radius);
  CHECK(derived.cell_size == NavMeshSettings{}.cell_size);
  std::filesystem::remove(path);
  CHECK_THROWS_AS(mesh->save("/no/such/folder/x.navmesh"), FileError);
  CHECK_THROWS_AS(mesh->save(path, 3), ArgumentError);
}

TEST_CASE("a side that only one of its polygons knows of is a wall, and the reason where no way leads around it") {
  test::Soup soup;  // two rooms and the corridor between them
  soup.floor(0, 0, 3, 3);
  soup.floor(3, 1, 6, 2);
  soup.floor(6, 0, 9, 3);
  const std::string path = scratch_file("walls.navmesh");
  NavMesh::from_triangles(soup.vertices, soup.triangles)->save(path, 1);
  const TileFile good(read_all(path));
  int disconnected = 0;
  for (int i = 0; i < good.header.polyCount; ++i) {
    for (int k = 0; k < good.polygon(i).vertCount; ++k) {
      dtPoly polygon = good.polygon(i);
      if (polygon.neis[k] == 0) continue;
      polygon.neis[k] = 0;
      TileFile file = good;
      file.set_polygon(i, polygon);
      write_all(path, file.bytes());
      const auto mesh = NavMesh::load(path);
      const auto points = mesh->sample(12, 1, -1);
      const DistanceField field(mesh, {points.data(), 1});
      for (const Vector3f& point : points) {
        const Path way = mesh->shortest_path(point, points[0]);
        CHECK(std::isinf(way.length) == (way.reason != NoPathReason::kNone));
        CHECK(way.points.empty() == std::isinf(way.length));
        const Distance distance = field.distance(point);
        CHECK(std::isinf(distance.metres) == (distance.reason != NoPathReason::kNone));
        disconnected += way.reason == NoPathReason::kDisconnected && distance.reason == NoPathReason::kDisconnected;
      }
    }
  }
  CHECK(disconnected > 0);
  std::filesystem::remove(path);
}
