// SPDX-License-Identifier: Apache-2.0
#include "wiw/nav/step.hpp"

#include <algorithm>
#include <array>

namespace wiw::nav {
namespace {

constexpr int kMaxPolygons = 256;
constexpr double kMargin = 4e-3;  // units: 0.2 mm on the usual grid

struct Reached {
  Eigen::Vector3f point;
  dtPolyRef ref = 0;  // 0: nothing was walked
};

Reached slide(const dtNavMeshQuery& query, const dtQueryFilter& filter, const MeshPoint& start,
              const Eigen::Vector3f& end) {
  std::array<dtPolyRef, kMaxPolygons> visited{};
  int count = 0;
  Reached reached{start.point};
  query.moveAlongSurface(start.ref, start.point.data(), end.data(), &filter, reached.point.data(), visited.data(),
                         &count, kMaxPolygons);
  if (count > 0) reached.ref = visited[static_cast<std::size_t>(count - 1)];
  return reached;
}

// Detour's raycast now and then passes a corner; the plane's own test does not.
Reached stop_at_wall(const DetourMesh& mesh, const PolygonGraph& graph, const MeshPoint& start,
                     const Eigen::Vector3f& end) {
  const Point2 from = graph.inside(start.polygon, graph.to_plane(start.point), kMargin);
  const Stop stop = walk_straight(graph, start.polygon, from, graph.to_plane(end));
  const auto fraction = static_cast<float>(stop.fraction);
  return {start.point + fraction * (end - start.point), mesh.polygon_ref(stop.polygon)};
}

// A hair off the wall: Detour gives the height only of points strictly over the polygon, and a point on a wall without
// thickness belongs to both of its sides, so that the next step could start from the wrong one.
Eigen::Vector3f settle(const DetourMesh& mesh, const PolygonGraph& graph, const dtNavMeshQuery& query,
                       const Reached& reached) {
  const Point2 inside = graph.inside(mesh.polygon_index(reached.ref), graph.to_plane(reached.point), kMargin);
  Eigen::Vector3f point = graph.to_world(inside, reached.point.y());
  query.getPolyHeight(reached.ref, point.data(), &point.y());
  return point;
}

}  // namespace

Stop walk_straight(const PolygonGraph& graph, int polygon, Point2 start, Point2 end) {
  const Point2 way = end - start;
  Stop stop{0, polygon};
  for (std::size_t crossed = 0; crossed <= graph.polygons().size(); ++crossed) {
    const Polygon& p = graph.polygons()[stop.polygon];
    double exit = 1;
    int side = -1;
    for (int k = 0; k < p.sides; ++k) {
      const Point2 edge = p.at[p.after(k)] - p.at[k];
      const double approach = cross(edge, way);
      if (approach >= 0) continue;
      const double fraction = cross(edge, start - p.at[k]) / -approach;
      if (fraction < exit) {
        exit = fraction;
        side = k;
      }
    }
    stop.fraction = std::max(stop.fraction, exit);
    if (side < 0 || p.next[side] < 0) break;
    stop.polygon = p.next[side];
  }
  return stop;
}

Eigen::Vector3f walk(const DetourMesh& mesh, const PolygonGraph& graph, const std::vector<int>& polygon_island,
                     const MeshPoint& start, const Eigen::Vector3f& end, bool sliding) {
  const DetourMesh::Lease query(mesh);
  Reached reached = sliding ? slide(*query, mesh.filter(), start, end) : stop_at_wall(mesh, graph, start, end);
  if (reached.ref == 0) return start.point;
  reached.point = settle(mesh, graph, *query, reached);
  const auto landed = mesh.project(reached.point);
  const bool same = landed && polygon_island[landed->polygon] == polygon_island[start.polygon];
  return same ? landed->point : reached.point;
}

}  // namespace wiw::nav
