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

namespace {

/// Distance of a point to the left of side k.
double depth(const Polygon& polygon, int k, Point2 point) {
  const Point2 side = polygon.at[polygon.after(k)] - polygon.at[k];
  const double size = length(side);
  return size > 0 ? cross(side, point - polygon.at[k]) / size : 0;
}

/// Pushes the point off each side it is too near to. Moves it no farther than needed, but may fail in a sharp corner.
Point2 push_off_sides(const Polygon& polygon, Point2 point, double margin) {
  for (int round = 0; round < 3; ++round) {
    for (int k = 0; k < polygon.sides; ++k) {
      const Point2 side = polygon.at[polygon.after(k)] - polygon.at[k];
      const double missing = margin - depth(polygon, k, point);
      if (missing > 0 && length(side) > 0) point = point + missing / length(side) * Point2{-side.y, side.x};
    }
  }
  return point;
}

/// Moves the point towards the centre until every side is `margin` away, or half as far as from the centre.
Point2 pull_to_centre(const Polygon& polygon, Point2 point, double margin) {
  Point2 centre;
  for (int k = 0; k < polygon.sides; ++k) centre = centre + 1.0 / polygon.sides * polygon.at[k];
  double share = 0;
  for (int k = 0; k < polygon.sides; ++k) {
    const double from = depth(polygon, k, point), at_centre = depth(polygon, k, centre);
    const double wanted = std::min(margin, at_centre / 2);
    if (from < wanted) share = std::max(share, (wanted - from) / (at_centre - from));
  }
  return point + share * (centre - point);
}

}  // namespace

Point2 PolygonGraph::inside(int index, Point2 point, double margin) const {
  const Polygon& polygon = polygons_[index];
  const Point2 pushed = push_off_sides(polygon, point, margin);
  for (int k = 0; k < polygon.sides; ++k) {
    if (depth(polygon, k, pushed) < margin / 2) return pull_to_centre(polygon, point, margin / 2);
  }
  return pushed;
}

}  // namespace wiw::nav
