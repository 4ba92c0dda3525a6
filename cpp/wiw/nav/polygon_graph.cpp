// SPDX-License-Identifier: Apache-2.0
#include "wiw/nav/polygon_graph.hpp"

#include <algorithm>
#include <cmath>

namespace wiw::nav {

PolygonGraph::PolygonGraph(const DetourMesh& mesh, const std::vector<int>& polygon_island) {
  const dtMeshTile& tile = mesh.tile();
  choose_grid(tile);
  for (int i = 0; i < tile.header->polyCount; ++i) {
    Polygon polygon = flatten(tile, tile.polys[i]);
    const bool used = polygon_island[i] >= 0;
    for (std::int32_t& next : polygon.next) next = used && next >= 0 && polygon_island[next] >= 0 ? next : -1;
    polygons_.push_back(polygon);
  }
  join();
}

// Detour keeps 1 / cell size as the factor of its bounding volume tree, so that version 1 files tell it too.
void PolygonGraph::choose_grid(const dtMeshTile& tile) {
  constexpr double kFineGrid = 0x1p-17;
  constexpr double kMaxRounding = 0.02;  // units; single precision reaches it 1 km from the origin
  origin_x_ = tile.header->bmin[0];
  origin_z_ = tile.header->bmin[2];
  scale_ = tile.header->bvQuantFactor > 0 ? static_cast<double>(1.f / tile.header->bvQuantFactor) : kFineGrid;
  for (int v = 0; v < tile.header->vertCount; ++v) {
    const Point2 point = to_plane(Eigen::Vector3f(tile.verts + 3 * v));
    const double rounding = std::max(std::abs(point.x - std::round(point.x)), std::abs(point.y - std::round(point.y)));
    if (rounding > kMaxRounding) {
      scale_ = kFineGrid;
      return;
    }
  }
}

Polygon PolygonGraph::flatten(const dtMeshTile& tile, const dtPoly& poly) const {
  Polygon polygon;
  polygon.sides = static_cast<std::int8_t>(poly.vertCount);
  // Detour winds clockwise in (x, z): corners are taken in reverse, and side k then is Detour's side n - 2 - k.
  for (int k = 0; k < poly.vertCount; ++k) {
    const int corner = poly.vertCount - 1 - k;
    const int side = (2 * poly.vertCount - 2 - k) % poly.vertCount;
    const Point2 point = to_plane(Eigen::Vector3f(tile.verts + 3 * poly.verts[corner]));
    polygon.at[k] = {std::round(point.x), std::round(point.y)};
    polygon.vertex[k] = poly.verts[corner];
    polygon.next[k] = poly.neis[side] - 1;
  }
  return polygon;
}

// A side that its neighbour does not know of, as a damaged file may have it, becomes a wall.
void PolygonGraph::join() {
  for (std::size_t i = 0; i < polygons_.size(); ++i) {
    Polygon& polygon = polygons_[i];
    for (int k = 0; k < polygon.sides; ++k) {
      if (polygon.next[k] < 0) continue;
      const Polygon& other = polygons_[polygon.next[k]];
      const auto matches = [&](int side) {
        return other.next[side] == static_cast<int>(i) && other.vertex[side] == polygon.vertex[polygon.after(k)] &&
               other.vertex[other.after(side)] == polygon.vertex[k];
      };
      int side = 0;
      while (side < other.sides && !matches(side)) ++side;
      if (side < other.sides) {
        polygon.back[k] = static_cast<std::int8_t>(side);
      } else {
        polygon.next[k] = -1;
      }
    }
  }
}

Point2 PolygonGraph::inside(int index, Point2 point, double margin) const {
  const double max_move = 50 * margin;  // in a needle-sharp corner every point is near both walls
  const Polygon& polygon = polygons_[index];
  Point2 moved = point;
  for (int round = 0; round < 4; ++round) {
    for (int k = 0; k < polygon.sides; ++k) {
      const Point2 side = polygon.at[polygon.after(k)] - polygon.at[k];
      const double size = length(side);
      const double distance = size > 0 ? cross(side, moved - polygon.at[k]) / size : margin;
      if (distance < margin) moved = moved + (margin - distance) / size * Point2{-side.y, side.x};
    }
  }
  const double moved_by = length(moved - point);
  return moved_by <= max_move ? moved : point + max_move / moved_by * (moved - point);
}

}  // namespace wiw::nav
