// SPDX-License-Identifier: Apache-2.0
#include "wiw/nav/detour_path.hpp"

#include <algorithm>

namespace wiw::nav {
namespace {

constexpr int kMaxPolygons = 256;

std::vector<Eigen::Vector3f> search(const dtNavMeshQuery& query, const dtQueryFilter& filter, const MeshPoint& start,
                                    const MeshPoint& end, int max_polygons) {
  std::vector<dtPolyRef> corridor(static_cast<std::size_t>(max_polygons));
  int length = 0;
  // Any detail bit (partial result, buffer too small, out of nodes) counts as failure, as in Habitat.
  if (query.findPath(start.ref, end.ref, start.point.data(), end.point.data(), &filter, corridor.data(), &length,
                     max_polygons) != DT_SUCCESS ||
      length == 0) {
    return {};
  }
  const int capacity = std::max(max_polygons, 2);
  std::vector<Eigen::Vector3f> points(static_cast<std::size_t>(capacity));
  int count = 0;
  if (query.findStraightPath(start.point.data(), end.point.data(), corridor.data(), length, points[0].data(), nullptr,
                             nullptr, &count, capacity) != DT_SUCCESS) {
    return {};
  }
  points.resize(static_cast<std::size_t>(count));
  return points;
}

}  // namespace

std::vector<Eigen::Vector3f> detour_path(const DetourMesh& mesh, const MeshPoint& start, const MeshPoint& end,
                                         bool capped) {
  if (capped) {
    const DetourMesh::Lease query(mesh);
    return search(*query, mesh.filter(), start, end, kMaxPolygons);
  }
  const int polygons = mesh.tile().header->polyCount;
  constexpr int kMaxNodeIndex = 65534;  // node indices are 16 bits wide; a single tile never has more polygons
  const auto query = mesh.make_query(std::min(polygons + 1, kMaxNodeIndex));
  return search(*query, mesh.filter(), start, end, polygons + 2);
}

double polyline_length(const std::vector<Eigen::Vector3f>& points) {
  double length = 0;
  for (std::size_t i = 1; i < points.size(); ++i) length += (points[i] - points[i - 1]).norm();
  return length;
}

}  // namespace wiw::nav
