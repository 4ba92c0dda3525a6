// SPDX-License-Identifier: Apache-2.0
#include "wiw/nav/navmesh_file.hpp"

#include <array>
#include <bit>
#include <cstring>
#include <fstream>
#include <type_traits>

#include "wiw/core/error.hpp"
#include "wiw/nav/tile_check.hpp"

namespace wiw::nav {
namespace {

static_assert(std::endian::native == std::endian::little, "the file is little-endian and copied as it lies");

constexpr std::int32_t kMagic = 'M' << 24 | 'S' << 16 | 'E' << 8 | 'T';
constexpr std::size_t kMaxFileBytes = std::size_t{1} << 30;

struct FileHeader {
  std::int32_t magic = kMagic;
  std::int32_t version = 2;
  std::int32_t tiles = 1;
  dtNavMeshParams params{};
};
static_assert(sizeof(FileHeader) == 40);

struct TileHeader {
  std::uint32_t ref = 0;
  std::int32_t size = 0;
};

// The settings as version 2 stores them: 13 floats, then 4 flags of one byte each.
struct StoredSettings {
  std::array<float, 13> numbers{};
  std::array<std::uint8_t, 4> flags{};
};
static_assert(sizeof(StoredSettings) == 56);

StoredSettings pack(const NavMeshSettings& s) {
  return {{s.cell_size, s.cell_height, s.agent_height, s.agent_radius, s.agent_max_climb, s.agent_max_slope,
           s.region_min_size, s.region_merge_size, s.edge_max_length, s.edge_max_error, s.vertices_per_polygon,
           s.detail_sample_distance, s.detail_sample_max_error},
          {s.filter_low_hanging_obstacles, s.filter_ledge_spans, s.filter_walkable_low_height_spans,
           s.include_static_objects}};
}

NavMeshSettings unpack(const StoredSettings& stored) {
  NavMeshSettings s;
  float* const fields[] = {&s.cell_size,
                           &s.cell_height,
                           &s.agent_height,
                           &s.agent_radius,
                           &s.agent_max_climb,
                           &s.agent_max_slope,
                           &s.region_min_size,
                           &s.region_merge_size,
                           &s.edge_max_length,
                           &s.edge_max_error,
                           &s.vertices_per_polygon,
                           &s.detail_sample_distance,
                           &s.detail_sample_max_error};
  for (std::size_t i = 0; i < stored.numbers.size(); ++i) *fields[i] = stored.numbers[i];
  s.filter_low_hanging_obstacles = stored.flags[0] != 0;
  s.filter_ledge_spans = stored.flags[1] != 0;
  s.filter_walkable_low_height_spans = stored.flags[2] != 0;
  s.include_static_objects = stored.flags[3] == 1;  // older writers leave this byte unset, so only 1 counts
  return s;
}

class NavMeshReader {
 public:
  NavMeshReader(std::string path, std::vector<std::uint8_t> bytes) : path_(std::move(path)), bytes_(std::move(bytes)) {}

  template <class T>
  T read(const char* what) {
    static_assert(std::is_trivially_copyable_v<T>);
    T value;
    std::memcpy(&value, take(sizeof(T), what), sizeof(T));
    return value;
  }
  const std::uint8_t* take(std::size_t count, const char* what) {
    if (bytes_.size() - offset_ < count) {
      fail("ends inside " + std::string(what) + ": expected " + std::to_string(count) + " more bytes at offset " +
           std::to_string(offset_) + ", got " + std::to_string(bytes_.size() - offset_));
    }
    const std::uint8_t* start = bytes_.data() + offset_;
    offset_ += count;
    return start;
  }
  void expect_end() const {
    if (offset_ != bytes_.size()) fail(std::to_string(bytes_.size() - offset_) + " bytes follow the last tile");
  }
  [[noreturn]] void fail(const std::string& cause) const { throw FileError(path_, cause); }

 private:
  std::string path_;
  std::vector<std::uint8_t> bytes_;
  std::size_t offset_ = 0;
};

std::vector<std::uint8_t> read_bytes(const std::string& path) {
  std::ifstream stream(path, std::ios::binary | std::ios::ate);
  if (!stream) throw FileError(path, "cannot be opened");
  const auto size = stream.tellg();
  if (size < 0 || static_cast<std::size_t>(size) > kMaxFileBytes) {
    throw FileError(path, "expected a regular file of at most 1 GiB");
  }
  std::vector<std::uint8_t> bytes(static_cast<std::size_t>(size));
  stream.seekg(0);
  stream.read(reinterpret_cast<char*>(bytes.data()), static_cast<std::streamsize>(size));
  if (!stream) throw FileError(path, "cannot be read");
  return bytes;
}

FileHeader read_header(NavMeshReader& reader) {
  const auto header = reader.read<FileHeader>("the header");
  if (header.magic != kMagic) reader.fail("does not begin with 'TESM', the mark of a Habitat navigation mesh");
  if (header.version != 1 && header.version != 2) {
    reader.fail("expected version 1 or 2, got " + std::to_string(header.version));
  }
  if (header.tiles != 1) {
    reader.fail("expected 1 tile, as Habitat writes, got " + std::to_string(header.tiles) +
                "; rebuild the mesh from its scene");
  }
  return header;
}

NavMeshSettings settings_of_tile(const std::vector<std::uint8_t>& tile) {
  dtMeshHeader header;
  std::memcpy(&header, tile.data(), sizeof header);
  NavMeshSettings settings;
  settings.agent_height = header.walkableHeight;
  settings.agent_radius = header.walkableRadius;
  settings.agent_max_climb = header.walkableClimb;
  return settings;
}

}  // namespace

NavMeshFile read_navmesh(const std::string& path) {
  NavMeshReader reader(path, read_bytes(path));
  NavMeshFile file;
  file.version = read_header(reader).version;
  StoredSettings stored;
  if (file.version == 2) stored = reader.read<StoredSettings>("the settings");
  const auto tile = reader.read<TileHeader>("the tile's size");
  if (tile.size < 0) reader.fail("holds a tile of negative size, " + std::to_string(tile.size));
  const auto size = static_cast<std::size_t>(tile.size);
  const std::uint8_t* data = reader.take(size, "the tile");
  reader.expect_end();
  file.tile.assign(data, data + size);
  if (const std::string fault = find_tile_fault(file.tile); !fault.empty()) reader.fail(fault);
  file.settings = file.version == 2 ? unpack(stored) : settings_of_tile(file.tile);
  try {
    file.settings.validate();
  } catch (const ArgumentError& error) {
    reader.fail(std::string("holds damaged settings: ") + error.what());
  }
  return file;
}

void write_navmesh(const std::string& path, int version, const NavMeshSettings& settings, const dtNavMesh& mesh) {
  if (version != 1 && version != 2) throw ArgumentError("expected version 1 or 2, got " + std::to_string(version));
  std::ofstream stream(path, std::ios::binary | std::ios::trunc);
  if (!stream) throw FileError(path, "cannot be opened for writing");
  const auto put = [&](const void* data, std::size_t size) {
    stream.write(static_cast<const char*>(data), static_cast<std::streamsize>(size));
  };
  const dtMeshTile* tile = mesh.getTile(0);
  const FileHeader header{.version = version, .params = *mesh.getParams()};
  put(&header, sizeof header);
  if (version == 2) {
    const StoredSettings stored = pack(settings);
    put(&stored, sizeof stored);
  }
  const TileHeader tile_header{mesh.getTileRef(tile), tile->dataSize};
  put(&tile_header, sizeof tile_header);
  put(tile->data, static_cast<std::size_t>(tile->dataSize));
  if (!stream.flush()) throw FileError(path, "cannot be written completely (disk full?)");
}

}  // namespace wiw::nav
