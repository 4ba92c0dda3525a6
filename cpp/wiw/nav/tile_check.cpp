// SPDX-License-Identifier: Apache-2.0
#include "wiw/nav/tile_check.hpp"

#include <DetourNavMesh.h>

#include <algorithm>
#include <cmath>
#include <cstring>
#include <vector>

namespace wiw::nav {
namespace {

// The arrays of a tile in the order they lie in it, copied out so that nothing depends on alignment.
struct TileArrays {
  dtMeshHeader header;
  std::vector<float> vertices;
  std::vector<dtPoly> polygons;
  std::vector<dtPolyDetail> details;
  std::vector<float> detail_vertices;
  std::vector<std::uint8_t> detail_triangles;
  std::vector<dtBVNode> nodes;
};

std::string expected(const std::string& what, long long wanted, long long got) {
  return what + ": expected " + std::to_string(wanted) + ", got " + std::to_string(got);
}

std::string check_header(const dtMeshHeader& h) {
  if (h.magic != DT_NAVMESH_MAGIC) return "the tile does not begin with Detour's mark 'DNAV'";
  if (h.version != DT_NAVMESH_VERSION) return expected("Detour tile version", DT_NAVMESH_VERSION, h.version);
  constexpr int kMaxCount = 1 << 26;
  for (const int count : {h.polyCount, h.vertCount, h.maxLinkCount, h.detailMeshCount, h.detailVertCount,
                          h.detailTriCount, h.bvNodeCount}) {
    if (count < 0 || count > kMaxCount) return "the tile header holds an impossible count, " + std::to_string(count);
  }
  if (h.polyCount == 0 || h.polyCount > 0xFFFF || h.vertCount > 0xFFFF) {
    return "expected 1 to 65535 polygons and at most 65535 vertices, got " + std::to_string(h.polyCount) + " and " +
           std::to_string(h.vertCount);
  }
  if (h.offMeshConCount != 0) return "off-mesh connections are not supported; rebuild the mesh without them";
  if (h.detailMeshCount != h.polyCount) return expected("height detail meshes", h.polyCount, h.detailMeshCount);
  if (h.x != 0 || h.y != 0 || h.layer != 0) return "expected the tile at grid location 0, 0, 0";
  for (int axis = 0; axis < 3; ++axis) {
    const bool ordered = std::isfinite(h.bmin[axis]) && std::isfinite(h.bmax[axis]) && h.bmin[axis] <= h.bmax[axis];
    if (!ordered || std::abs(h.bmin[axis]) > 1e6f || std::abs(h.bmax[axis]) > 1e6f)
      return "the tile's bounds are damaged";
  }
  if (h.bmax[0] - h.bmin[0] < 1e-3f || h.bmax[2] - h.bmin[2] < 1e-3f) return "the tile's bounds are empty";
  const bool has_grid = h.bvQuantFactor == 0.f || (h.bvQuantFactor >= 1e-6f && h.bvQuantFactor <= 1e6f);
  return std::isfinite(h.walkableClimb) && has_grid ? "" : "the tile header holds a damaged number";
}

template <class T>
void take(std::span<const std::uint8_t> bytes, std::size_t& offset, int count, std::vector<T>& array) {
  array.resize(static_cast<std::size_t>(count));
  if (count > 0) std::memcpy(array.data(), bytes.data() + offset, array.size() * sizeof(T));
  offset += (array.size() * sizeof(T) + 3) & ~std::size_t{3};
}

std::size_t size_of_arrays(const dtMeshHeader& h) {
  const auto bytes = [](int count, std::size_t size) {
    return (static_cast<std::size_t>(count) * size + 3) & ~std::size_t{3};
  };
  return bytes(1, sizeof(dtMeshHeader)) + bytes(h.vertCount, 12) + bytes(h.polyCount, sizeof(dtPoly)) +
         bytes(h.maxLinkCount, sizeof(dtLink)) + bytes(h.detailMeshCount, sizeof(dtPolyDetail)) +
         bytes(h.detailVertCount, 12) + bytes(h.detailTriCount, 4) + bytes(h.bvNodeCount, sizeof(dtBVNode));
}

TileArrays split(std::span<const std::uint8_t> bytes, const dtMeshHeader& header) {
  TileArrays tile{.header = header};
  std::size_t offset = sizeof(dtMeshHeader);
  take(bytes, offset, header.vertCount * 3, tile.vertices);
  take(bytes, offset, header.polyCount, tile.polygons);
  offset += static_cast<std::size_t>(header.maxLinkCount) * sizeof(dtLink);  // Detour writes the links itself
  take(bytes, offset, header.detailMeshCount, tile.details);
  take(bytes, offset, header.detailVertCount * 3, tile.detail_vertices);
  take(bytes, offset, header.detailTriCount * 4, tile.detail_triangles);
  take(bytes, offset, header.bvNodeCount, tile.nodes);
  return tile;
}

bool all_near(const std::vector<float>& coordinates) {
  for (const float x : coordinates) {
    if (!(std::abs(x) <= 1e6f)) return false;
  }
  return true;
}

std::string check_polygon(const TileArrays& tile, const dtPoly& polygon) {
  if (polygon.vertCount < 3 || polygon.vertCount > DT_VERTS_PER_POLYGON) {
    return "expected 3 to 6 corners, got " + std::to_string(polygon.vertCount);
  }
  if (polygon.getType() != DT_POLYTYPE_GROUND) return "expected a ground polygon";
  for (int k = 0; k < polygon.vertCount; ++k) {
    if (polygon.verts[k] >= tile.header.vertCount) return "a corner is not a vertex of the tile";
    const unsigned short neighbour = polygon.neis[k];
    if (neighbour & DT_EXT_LINK) return "a side leads to another tile; only single-tile meshes are supported";
    if (neighbour > tile.header.polyCount) return "a neighbour is not a polygon of the tile";
  }
  return "";
}

// Detour makes a link for each side with a neighbour and takes them from the room the tile sets aside, whose last one
// it marks without asking whether there is one.
std::string check_links(const TileArrays& tile) {
  int sides = 0;
  for (const dtPoly& polygon : tile.polygons) {
    for (int k = 0; k < polygon.vertCount; ++k) sides += polygon.neis[k] != 0;
  }
  if (tile.header.maxLinkCount >= std::max(1, sides)) return "";
  return "expected room for at least " + std::to_string(std::max(1, sides)) +
         " links, one for each side that two polygons share, got " + std::to_string(tile.header.maxLinkCount);
}

std::string check_detail(const TileArrays& tile, const dtPolyDetail& detail, int corners) {
  const auto vertices = static_cast<std::uint64_t>(detail.vertBase) + detail.vertCount;
  const auto triangles = static_cast<std::uint64_t>(detail.triBase) + detail.triCount;
  if (vertices > static_cast<std::uint64_t>(tile.header.detailVertCount) ||
      triangles > static_cast<std::uint64_t>(tile.header.detailTriCount)) {
    return "its height detail lies outside the tile's arrays";
  }
  constexpr int kAnyBoundary = DT_DETAIL_EDGE_BOUNDARY * 0b010101;
  bool bounded = false;  // Detour looks for the nearest boundary edge and takes for granted that there is one
  for (std::size_t t = detail.triBase; t < triangles; ++t) {
    bounded = bounded || (tile.detail_triangles[4 * t + 3] & kAnyBoundary);
    for (std::size_t k = 0; k < 3; ++k) {
      if (tile.detail_triangles[4 * t + k] >= corners + detail.vertCount)
        return "a height triangle names a missing vertex";
    }
  }
  return bounded ? "" : "its height detail has no boundary edge";
}

// A node's index is a polygon, or how far to jump when the box is missed; a jump must go forward and stay inside.
std::string check_tree(const TileArrays& tile) {
  const int count = tile.header.bvNodeCount;
  for (int i = 0; i < count; ++i) {
    const int target = tile.nodes[static_cast<std::size_t>(i)].i;
    const bool leaf_ok = target >= 0 && target < tile.header.polyCount;
    const bool jump_ok = target < 0 && target >= -(count - i);
    if (!leaf_ok && !jump_ok) return "node " + std::to_string(i) + " of the bounding volume tree points outside it";
  }
  return "";
}

}  // namespace

std::string find_tile_fault(std::span<const std::uint8_t> bytes) {
  if (bytes.size() < sizeof(dtMeshHeader))
    return expected("bytes in the tile header", sizeof(dtMeshHeader), static_cast<long long>(bytes.size()));
  dtMeshHeader header;
  std::memcpy(&header, bytes.data(), sizeof header);
  if (std::string fault = check_header(header); !fault.empty()) return fault;
  if (const std::size_t size = size_of_arrays(header); size != bytes.size()) {
    return expected("bytes in the tile, by its header", static_cast<long long>(size),
                    static_cast<long long>(bytes.size()));
  }
  const TileArrays tile = split(bytes, header);
  if (!all_near(tile.vertices) || !all_near(tile.detail_vertices)) {
    return "a vertex is not finite or lies beyond 1000 km";
  }
  for (std::size_t i = 0; i < tile.polygons.size(); ++i) {
    std::string fault = check_polygon(tile, tile.polygons[i]);
    if (fault.empty()) fault = check_detail(tile, tile.details[i], tile.polygons[i].vertCount);
    if (!fault.empty()) return "polygon " + std::to_string(i) + ": " + fault;
  }
  if (std::string fault = check_links(tile); !fault.empty()) return fault;
  return check_tree(tile);
}

}  // namespace wiw::nav
