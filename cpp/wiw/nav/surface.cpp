// SPDX-License-Identifier: Apache-2.0
#include "wiw/nav/surface.hpp"

#include <algorithm>
#include <numeric>

#include "wiw/nav/recast_build.hpp"

namespace wiw::nav {
namespace {

constexpr double kTinyArea = 1e-5;  // m2, Habitat's threshold

Eigen::Vector3f vertex(const dtMeshTile& tile, int index) { return Eigen::Vector3f(tile.verts + 3 * index); }

double triangle_area(const Eigen::Vector3f* p) {
  return 0.5 * (p[1] - p[0]).cast<double>().cross((p[2] - p[0]).cast<double>()).norm();
}

std::vector<Eigen::Vector3f> polygon_triangles(const dtMeshTile& tile, int polygon) {
  const dtPoly& poly = tile.polys[polygon];
  const dtPolyDetail& detail = tile.detailMeshes[polygon];
  std::vector<Eigen::Vector3f> corners;
  for (unsigned t = 0; t < detail.triCount; ++t) {
    const unsigned char* triangle = tile.detailTris + 4 * (detail.triBase + t);
    for (int k = 0; k < 3; ++k) {
      const int corner = triangle[k];
      corners.emplace_back(corner < poly.vertCount
                               ? vertex(tile, poly.verts[corner])
                               : Eigen::Vector3f(tile.detailVerts + 3 * (detail.vertBase + corner - poly.vertCount)));
    }
  }
  return corners;
}

double area_of(const std::vector<Eigen::Vector3f>& corners) {
  double area = 0;
  for (std::size_t t = 0; t < corners.size(); t += 3) area += triangle_area(&corners[t]);
  return area;
}

void flood(const DetourMesh& mesh, int seed, int island, std::vector<int>& polygon_island) {
  const dtMeshTile& tile = mesh.tile();
  std::vector<int> stack{seed};
  polygon_island[seed] = island;
  while (!stack.empty()) {
    const dtPoly& poly = tile.polys[stack.back()];
    stack.pop_back();
    for (unsigned link = poly.firstLink; link != DT_NULL_LINK; link = tile.links[link].next) {
      const int next = mesh.polygon_index(tile.links[link].ref);
      if (polygon_island[next] >= 0 || !(tile.polys[next].flags & kWalkable)) continue;
      polygon_island[next] = island;
      stack.push_back(next);
    }
  }
}

// Islands in order of discovery; returns their number.
int fill_islands(const DetourMesh& mesh, std::vector<int>& polygon_island) {
  const dtMeshTile& tile = mesh.tile();
  int count = 0;
  for (int i = 0; i < tile.header->polyCount; ++i) {
    if (polygon_island[i] < 0 && (tile.polys[i].flags & kWalkable)) flood(mesh, i, count++, polygon_island);
  }
  return count;
}

void sort_islands(Surface& surface) {
  std::vector<int> order(surface.islands.size());
  std::iota(order.begin(), order.end(), 0);
  std::stable_sort(order.begin(), order.end(),
                   [&](int a, int b) { return surface.islands[a].area > surface.islands[b].area; });
  std::vector<int> rank(order.size());
  std::vector<Island> sorted;
  for (std::size_t i = 0; i < order.size(); ++i) {
    rank[order[i]] = static_cast<int>(i);
    sorted.push_back(surface.islands[order[i]]);
  }
  surface.islands = std::move(sorted);
  for (int& island : surface.polygon_island) island = island < 0 ? -1 : rank[island];
}

void collect_outline(const DetourMesh& mesh, Surface& surface) {
  const dtMeshTile& tile = mesh.tile();
  for (int i = 0; i < tile.header->polyCount; ++i) {
    const dtPoly& poly = tile.polys[i];
    if (surface.polygon_island[i] < 0) continue;
    for (int k = 0; k < poly.vertCount; ++k) {
      if (poly.neis[k] != 0 && surface.polygon_island[poly.neis[k] - 1] >= 0) continue;
      surface.outline_island.push_back(surface.polygon_island[i]);
      surface.outline.push_back(vertex(tile, poly.verts[k]));
      surface.outline.push_back(vertex(tile, poly.verts[(k + 1) % poly.vertCount]));
    }
  }
}

void collect_triangles(const std::vector<std::vector<Eigen::Vector3f>>& triangles, Surface& surface) {
  std::vector<int> order(triangles.size());
  std::iota(order.begin(), order.end(), 0);
  std::stable_sort(order.begin(), order.end(),
                   [&](int a, int b) { return surface.polygon_island[a] < surface.polygon_island[b]; });
  double total = 0;
  for (const int polygon : order) {
    if (surface.polygon_island[polygon] < 0) continue;
    const auto& corners = triangles[polygon];
    for (std::size_t t = 0; t < corners.size(); t += 3) {
      total += triangle_area(&corners[t]);
      surface.cumulative_area.push_back(total);
      surface.triangle_island.push_back(surface.polygon_island[polygon]);
    }
    surface.corners.insert(surface.corners.end(), corners.begin(), corners.end());
  }
}

}  // namespace

Surface extract_surface(DetourMesh& mesh) {
  const dtMeshTile& tile = mesh.tile();
  const int count = tile.header->polyCount;
  std::vector<std::vector<Eigen::Vector3f>> triangles;
  for (int i = 0; i < count; ++i) {
    triangles.push_back(polygon_triangles(tile, i));
    if (area_of(triangles.back()) < kTinyArea) mesh.set_flags(i, kDisabled);
  }
  Surface surface;
  surface.polygon_island.assign(static_cast<std::size_t>(count), -1);
  surface.islands.resize(static_cast<std::size_t>(fill_islands(mesh, surface.polygon_island)));
  for (int i = 0; i < count; ++i) {
    if (surface.polygon_island[i] < 0) continue;
    Island& island = surface.islands[surface.polygon_island[i]];
    island.area += area_of(triangles[i]);
    ++island.polygons;
    for (const Eigen::Vector3f& corner : triangles[i]) island.bounds.extend(corner);
  }
  sort_islands(surface);
  collect_triangles(triangles, surface);
  collect_outline(mesh, surface);
  return surface;
}

}  // namespace wiw::nav
