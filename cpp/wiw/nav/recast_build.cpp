// SPDX-License-Identifier: Apache-2.0
#include "wiw/nav/recast_build.hpp"

#include <DetourAlloc.h>
#include <DetourNavMesh.h>
#include <DetourNavMeshBuilder.h>
#include <Recast.h>

#include <algorithm>
#include <cmath>
#include <memory>
#include <string>

#include "wiw/core/error.hpp"

namespace wiw::nav {
namespace {

template <auto free>
struct Free {
  template <class T>
  void operator()(T* pointer) const {
    free(pointer);
  }
};
using HeightfieldPtr = std::unique_ptr<rcHeightfield, Free<rcFreeHeightField>>;
using CompactPtr = std::unique_ptr<rcCompactHeightfield, Free<rcFreeCompactHeightfield>>;
using ContoursPtr = std::unique_ptr<rcContourSet, Free<rcFreeContourSet>>;
using PolygonsPtr = std::unique_ptr<rcPolyMesh, Free<rcFreePolyMesh>>;
using DetailPtr = std::unique_ptr<rcPolyMeshDetail, Free<rcFreePolyMeshDetail>>;

// Recast reports what went wrong only through its log; the last error becomes the exception's text.
class Context : public rcContext {
 public:
  Context() { enableTimer(false); }
  [[noreturn]] void fail(const char* stage) const {
    throw ArgumentError(std::string("navigation mesh: ") + stage + " failed" +
                        (last_error_.empty() ? "" : " (" + last_error_ + ")") +
                        "; raise cell_size or cut the scene into parts");
  }

 protected:
  void doLog(rcLogCategory category, const char* message, int length) override {
    if (category == RC_LOG_ERROR) last_error_.assign(message, static_cast<std::size_t>(length));
  }

 private:
  std::string last_error_;
};

int cells(float value) { return static_cast<int>(value); }

// Single precision on purpose: 0.2f / 0.2f floors to 1, and Habitat's files were derived this way.
rcConfig make_config(const NavMeshSettings& s, std::span<const Eigen::Vector3f> vertices) {
  rcConfig config{};
  config.cs = s.cell_size;
  config.ch = s.cell_height;
  config.walkableSlopeAngle = s.agent_max_slope;
  config.walkableHeight = cells(std::ceil(s.agent_height / s.cell_height));
  config.walkableClimb = cells(std::floor(s.agent_max_climb / s.cell_height));
  config.walkableRadius = cells(std::ceil(s.agent_radius / s.cell_size));
  config.maxEdgeLen = cells(s.edge_max_length / s.cell_size);
  config.maxSimplificationError = s.edge_max_error;
  config.minRegionArea = cells(s.region_min_size * s.region_min_size);
  config.mergeRegionArea = cells(s.region_merge_size * s.region_merge_size);
  config.maxVertsPerPoly = cells(s.vertices_per_polygon);
  config.detailSampleDist = s.detail_sample_distance < 0.9f ? 0.f : s.cell_size * s.detail_sample_distance;
  config.detailSampleMaxError = s.cell_height * s.detail_sample_max_error;
  rcCalcBounds(vertices[0].data(), static_cast<int>(vertices.size()), config.bmin, config.bmax);
  return config;
}

// The limits are the widths of Recast's bit fields; beyond them it would wrap silently.
void check_extent(rcConfig& config) {
  constexpr double kMaxCells = 2e8;
  const double width = (config.bmax[0] - config.bmin[0]) / config.cs;
  const double depth = (config.bmax[2] - config.bmin[2]) / config.cs;
  const double height = (config.bmax[1] - config.bmin[1]) / config.ch;
  const bool fits = std::isfinite(width) && std::isfinite(depth) && std::isfinite(height) &&
                    width * depth <= kMaxCells && width < 65535 && depth < 65535 && height < RC_SPAN_MAX_HEIGHT;
  if (!fits) {
    throw ArgumentError("expected a scene of at most 65534 x 8190 x 65534 cells and 2e8 columns, got " +
                        std::to_string(width) + " x " + std::to_string(height) + " x " + std::to_string(depth) +
                        "; raise cell_size or cell_height, or check the scene's units");
  }
  rcCalcGridSize(config.bmin, config.bmax, config.cs, &config.width, &config.height);
  config.width = std::max(config.width, 1);  // a scene thinner than half a cell
  config.height = std::max(config.height, 1);
}

// Recast counts cells below a ceiling, and twice the cells to a wall, in one byte each: more would wrap, or leave
// floors that the agent can step between without a connection.
void check_body(const rcConfig& config) {
  constexpr int kMostRadius = 127;
  constexpr int kMostHeight = 255;
  if (config.walkableRadius > kMostRadius) {
    throw ArgumentError("expected agent_radius of at most " + std::to_string(kMostRadius) + " x cell_size, got " +
                        std::to_string(config.walkableRadius) + " cells; raise cell_size");
  }
  if (config.walkableHeight + config.walkableClimb > kMostHeight) {
    throw ArgumentError("expected agent_height and agent_max_climb of at most " + std::to_string(kMostHeight) +
                        " x cell_height together, got " + std::to_string(config.walkableHeight) + " and " +
                        std::to_string(config.walkableClimb) + " cells; raise cell_height");
  }
}

HeightfieldPtr voxelise(Context& context, const rcConfig& config, const NavMeshSettings& settings,
                        std::span<const Eigen::Vector3f> vertices,
                        std::span<const Eigen::Matrix<std::uint32_t, 3, 1>> triangles) {
  HeightfieldPtr solid(rcAllocHeightfield());
  if (!solid || !rcCreateHeightfield(&context, *solid, config.width, config.height, config.bmin, config.bmax, config.cs,
                                     config.ch)) {
    context.fail("allocating the height field");
  }
  const auto* points = vertices[0].data();
  const auto* indices = reinterpret_cast<const int*>(triangles.data());
  const int num_points = static_cast<int>(vertices.size());
  const int num_triangles = static_cast<int>(triangles.size());
  std::vector<unsigned char> areas(triangles.size(), RC_NULL_AREA);
  rcMarkWalkableTriangles(&context, config.walkableSlopeAngle, points, num_points, indices, num_triangles,
                          areas.data());
  if (!rcRasterizeTriangles(&context, points, num_points, indices, areas.data(), num_triangles, *solid,
                            config.walkableClimb)) {
    context.fail("rasterising");
  }
  if (settings.filter_low_hanging_obstacles) {
    rcFilterLowHangingWalkableObstacles(&context, config.walkableClimb, *solid);
  }
  if (settings.filter_ledge_spans) {
    rcFilterLedgeSpans(&context, config.walkableHeight, config.walkableClimb, *solid);
  }
  if (settings.filter_walkable_low_height_spans) {
    rcFilterWalkableLowHeightSpans(&context, config.walkableHeight, *solid);
  }
  return solid;
}

CompactPtr partition(Context& context, const rcConfig& config, HeightfieldPtr solid) {
  constexpr int kMaxSpans = (1 << 24) - 1;  // rcCompactCell::index has 24 bits
  if (const int spans = rcGetHeightFieldSpanCount(&context, *solid); spans > kMaxSpans) {
    throw ArgumentError("expected at most " + std::to_string(kMaxSpans) + " walkable voxels in one tile, got " +
                        std::to_string(spans) + "; raise cell_size");
  }
  CompactPtr compact(rcAllocCompactHeightfield());
  if (!compact || !rcBuildCompactHeightfield(&context, config.walkableHeight, config.walkableClimb, *solid, *compact)) {
    context.fail("compacting the height field");
  }
  solid.reset();
  if (!rcErodeWalkableArea(&context, config.walkableRadius, *compact)) context.fail("eroding by the agent's radius");
  if (!rcBuildDistanceField(&context, *compact)) context.fail("the distance field");
  if (!rcBuildRegions(&context, *compact, 0, config.minRegionArea, config.mergeRegionArea)) {
    context.fail("the watershed regions");
  }
  return compact;
}

PolygonsPtr trace(Context& context, const rcConfig& config, rcCompactHeightfield& compact) {
  ContoursPtr contours(rcAllocContourSet());
  if (!contours || !rcBuildContours(&context, compact, config.maxSimplificationError, config.maxEdgeLen, *contours)) {
    context.fail("tracing contours");
  }
  PolygonsPtr polygons(rcAllocPolyMesh());
  if (!polygons || !rcBuildPolyMesh(&context, *contours, config.maxVertsPerPoly, *polygons)) {
    context.fail("building polygons");
  }
  if (polygons->npolys == 0) {
    throw ArgumentError(
        "nothing in this scene is walkable for the agent: expected a floor of at least region_min_size^2 cells, no "
        "steeper than agent_max_slope, with agent_height above it; check the up axis and the units");
  }
  for (int i = 0; i < polygons->npolys; ++i) {
    if (polygons->areas[i] != RC_WALKABLE_AREA) continue;
    polygons->areas[i] = kGroundArea;
    polygons->flags[i] = kWalkable;
  }
  return polygons;
}

std::vector<std::uint8_t> to_tile(const rcConfig& config, const NavMeshSettings& settings, const rcPolyMesh& polygons,
                                  const rcPolyMeshDetail& detail) {
  dtNavMeshCreateParams params{};
  params.verts = polygons.verts;
  params.vertCount = polygons.nverts;
  params.polys = polygons.polys;
  params.polyAreas = polygons.areas;
  params.polyFlags = polygons.flags;
  params.polyCount = polygons.npolys;
  params.nvp = polygons.nvp;
  params.detailMeshes = detail.meshes;
  params.detailVerts = detail.verts;
  params.detailVertsCount = detail.nverts;
  params.detailTris = detail.tris;
  params.detailTriCount = detail.ntris;
  params.walkableHeight = settings.agent_height;
  params.walkableRadius = settings.agent_radius;
  params.walkableClimb = settings.agent_max_climb;
  for (int axis = 0; axis < 3; ++axis) {
    params.bmin[axis] = polygons.bmin[axis];
    params.bmax[axis] = polygons.bmax[axis];
  }
  params.cs = config.cs;
  params.ch = config.ch;
  params.buildBvTree = true;
  unsigned char* data = nullptr;
  int size = 0;
  if (!dtCreateNavMeshData(&params, &data, &size)) {
    throw ArgumentError("the walkable surface needs more than 65534 vertices; raise cell_size or edge_max_error");
  }
  std::vector<std::uint8_t> tile(data, data + size);
  dtFree(data);
  return tile;
}

void check_triangles(std::span<const Eigen::Vector3f> vertices,
                     std::span<const Eigen::Matrix<std::uint32_t, 3, 1>> triangles) {
  if (vertices.empty() || triangles.empty()) throw ArgumentError("expected at least one triangle, got an empty mesh");
  constexpr std::size_t kMaxCount = 1u << 30;
  if (vertices.size() > kMaxCount || triangles.size() > kMaxCount) {
    throw ArgumentError("expected at most 2^30 vertices and triangles");
  }
  for (std::size_t i = 0; i < vertices.size(); ++i) {
    if (!vertices[i].allFinite()) throw ArgumentError("vertex " + std::to_string(i) + " is not finite");
  }
  for (std::size_t i = 0; i < triangles.size(); ++i) {
    if (triangles[i].maxCoeff() >= vertices.size()) {
      throw ArgumentError("face " + std::to_string(i) + " names a vertex beyond the " +
                          std::to_string(vertices.size()) + " given");
    }
  }
}

}  // namespace

std::vector<std::uint8_t> build_tile(std::span<const Eigen::Vector3f> vertices,
                                     std::span<const Eigen::Matrix<std::uint32_t, 3, 1>> triangles,
                                     const NavMeshSettings& settings) {
  settings.validate();
  check_triangles(vertices, triangles);
  Context context;
  rcConfig config = make_config(settings, vertices);
  check_body(config);
  check_extent(config);
  const CompactPtr compact = partition(context, config, voxelise(context, config, settings, vertices, triangles));
  const PolygonsPtr polygons = trace(context, config, *compact);
  const DetailPtr detail(rcAllocPolyMeshDetail());
  if (!detail || !rcBuildPolyMeshDetail(&context, *polygons, *compact, config.detailSampleDist,
                                        config.detailSampleMaxError, *detail)) {
    context.fail("building the height detail");
  }
  return to_tile(config, settings, *polygons, *detail);
}

}  // namespace wiw::nav
