// SPDX-License-Identifier: Apache-2.0
#include "wiw/nav/step.hpp"

#include <algorithm>
#include <array>

namespace wiw::nav {
namespace {

constexpr int kMaxPolygons = 256;
constexpr float kNudge = 1e-4f;  // metres, as in Habitat

struct Reached {
  Eigen::Vector3f point;
  dtPolyRef ref = 0;  // 0: nothing was walked
};

Reached slide(const dtNavMeshQuery& query, const dtQueryFilter& filter, const Projection& start,
              const Eigen::Vector3f& end) {
  std::array<dtPolyRef, kMaxPolygons> visited{};
  int count = 0;
  Reached reached{start.point};
  query.moveAlongSurface(start.ref, start.point.data(), end.data(), &filter, reached.point.data(), visited.data(),
                         &count, kMaxPolygons);
  if (count > 0) reached.ref = visited[static_cast<std::size_t>(count - 1)];
  return reached;
}

// t is the part of the way walked before a wall; FLT_MAX when there is none.
Reached stop_at_wall(const dtNavMeshQuery& query, const dtQueryFilter& filter, const Projection& start,
                     const Eigen::Vector3f& end) {
  std::array<dtPolyRef, kMaxPolygons> visited{};
  int count = 0;
  float t = 0;
  Eigen::Vector3f normal;
  query.raycast(start.ref, start.point.data(), end.data(), &filter, &t, normal.data(), visited.data(), &count,
                kMaxPolygons);
  Reached reached{start.point + std::clamp(t, 0.f, 1.f) * (end - start.point)};
  if (count > 0) reached.ref = visited[static_cast<std::size_t>(count - 1)];
  return reached;
}

Eigen::Vector3f polygon_centre(const dtMeshTile& tile, int polygon) {
  const dtPoly& poly = tile.polys[polygon];
  Eigen::Vector3f sum = Eigen::Vector3f::Zero();
  for (int k = 0; k < poly.vertCount; ++k) sum += Eigen::Vector3f(tile.verts + 3 * poly.verts[k]);
  return sum / poly.vertCount;
}

}  // namespace

Eigen::Vector3f walk(const DetourMesh& mesh, const std::vector<int>& polygon_island, const Projection& start,
                     const Eigen::Vector3f& end, bool sliding) {
  const DetourMesh::Lease query(mesh);
  Reached reached =
      sliding ? slide(*query, mesh.filter(), start, end) : stop_at_wall(*query, mesh.filter(), start, end);
  if (reached.ref == 0) return start.point;
  query->getPolyHeight(reached.ref, reached.point.data(), &reached.point.y());
  // The height of a point on a polygon's side can be that of the neighbour's detail; the projection settles it.
  const auto landed = mesh.project(reached.point);
  if (landed && polygon_island[landed->polygon] == polygon_island[start.polygon]) return landed->point;
  // Walls can be infinitely thin: a point on one belongs to both sides, and the next step could start from the other.
  const Eigen::Vector3f inward = polygon_centre(mesh.tile(), mesh.polygon_index(reached.ref)) - reached.point;
  return reached.point + kNudge * inward.normalized();
}

}  // namespace wiw::nav
