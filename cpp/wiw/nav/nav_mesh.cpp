// SPDX-License-Identifier: Apache-2.0
#include "wiw/nav/nav_mesh.hpp"

#include <algorithm>
#include <cmath>
#include <limits>

#include "wiw/core/error.hpp"
#include "wiw/core/rng.hpp"
#include "wiw/nav/detour_path.hpp"
#include "wiw/nav/navmesh_file.hpp"
#include "wiw/nav/recast_build.hpp"
#include "wiw/nav/step.hpp"

namespace wiw::nav {

const char* reason_text(Reason reason) {
  switch (reason) {
    case Reason::kNone: return "";
    case Reason::kStartOffMesh: return "start off mesh";
    case Reason::kEndOffMesh: return "end off mesh";
    case Reason::kOtherIsland: return "other island";
    case Reason::kSearchLimit: return "search limit of 256 polygons or 2048 nodes";
  }
  return "";
}

NavMesh::NavMesh(std::vector<std::uint8_t> tile, const NavMeshSettings& settings)
    : settings_(settings), mesh_(std::move(tile)), surface_(extract_surface(mesh_)) {}

std::shared_ptr<NavMesh> NavMesh::from_triangles(std::span<const Eigen::Vector3f> vertices,
                                                 std::span<const Eigen::Matrix<std::uint32_t, 3, 1>> triangles,
                                                 const NavMeshSettings& settings) {
  return std::shared_ptr<NavMesh>(new NavMesh(build_tile(vertices, triangles, settings), settings));
}

std::shared_ptr<NavMesh> NavMesh::build(const Scene& scene, const NavMeshSettings& settings) {
  const TriangleSoup soup = world_triangles(scene);
  return from_triangles(soup.vertices, soup.triangles, settings);
}

std::shared_ptr<NavMesh> NavMesh::load(const std::string& path) {
  NavMeshFile file = read_navmesh(path);
  return std::shared_ptr<NavMesh>(new NavMesh(std::move(file.tile), file.settings));
}

void NavMesh::save(const std::string& path, int version) const {
  write_navmesh(path, version, settings_, mesh_.mesh());
}

Eigen::AlignedBox3f NavMesh::bounds() const {
  Eigen::AlignedBox3f box;
  for (const Island& island : surface_.islands) box.extend(island.bounds);
  return box;
}

std::optional<Eigen::Vector3f> NavMesh::snap(const Eigen::Vector3f& point) const {
  const auto projection = mesh_.project(point);
  if (!projection) return std::nullopt;
  return projection->point;
}

int NavMesh::island_of(const Eigen::Vector3f& point) const {
  const auto projection = mesh_.project(point);
  return projection ? surface_.polygon_island[projection->polygon] : -1;
}

bool NavMesh::is_navigable(const Eigen::Vector3f& point, float max_dy) const {
  constexpr float kMaxOffset = 1e-2f;
  const auto projection = mesh_.project(point);
  if (!projection) return false;
  const Eigen::Vector3f offset = projection->point - point;
  return std::abs(offset.y()) <= max_dy && std::hypot(offset.x(), offset.z()) <= kMaxOffset;
}

std::vector<Eigen::Vector3f> NavMesh::sample(std::size_t count, std::uint64_t seed, int island) const {
  const auto islands = static_cast<int>(surface_.islands.size());
  if (island < -1 || island >= islands) {
    throw ArgumentError("expected an island in [-1, " + std::to_string(islands) + "), got " + std::to_string(island));
  }
  const auto& owner = surface_.triangle_island;  // sorted
  const auto first = island < 0 ? owner.begin() : std::lower_bound(owner.begin(), owner.end(), island);
  const auto last = island < 0 ? owner.end() : std::upper_bound(owner.begin(), owner.end(), island);
  const auto begin = first - owner.begin();
  const auto end = last - owner.begin();
  const double low = begin == 0 ? 0 : surface_.cumulative_area[begin - 1];
  const double high = end == 0 ? 0 : surface_.cumulative_area[end - 1];
  Rng rng(seed);
  std::vector<Eigen::Vector3f> points;
  points.reserve(count);
  for (std::size_t i = 0; i < count; ++i) {
    const auto sums = surface_.cumulative_area.begin();
    const auto triangle = std::min(std::upper_bound(sums + begin, sums + end, rng.uniform(low, high)) - sums, end - 1);
    // Osada et al. 2002: uniform over a triangle.
    const double root = std::sqrt(rng.uniform());
    const double v = rng.uniform();
    const Eigen::Vector3f* p = &surface_.corners[3 * static_cast<std::size_t>(triangle)];
    points.emplace_back(
        ((1 - root) * p[0].cast<double>() + root * (1 - v) * p[1].cast<double>() + root * v * p[2].cast<double>())
            .cast<float>());
  }
  return points;
}

Eigen::Vector3f NavMesh::try_step(const Eigen::Vector3f& start, const Eigen::Vector3f& end, bool sliding) const {
  const auto from = mesh_.project(start);
  const auto to = mesh_.project(end);
  const bool connected = from && to && surface_.polygon_island[from->polygon] == surface_.polygon_island[to->polygon];
  return connected ? walk(mesh_, surface_.polygon_island, *from, end, sliding) : start;
}

Distance NavMesh::geodesic_distance(const Eigen::Vector3f& start, const Eigen::Vector3f& end, Metric metric) const {
  const Path path = shortest_path(start, end, metric);
  return {path.length, path.reason};
}

Path NavMesh::shortest_path(const Eigen::Vector3f& start, const Eigen::Vector3f& end, Metric metric) const {
  Path path{.length = std::numeric_limits<double>::infinity()};
  const auto from = mesh_.project(start);
  const auto to = mesh_.project(end);
  if (!from || !to) {
    path.reason = from ? Reason::kEndOffMesh : Reason::kStartOffMesh;
    return path;
  }
  if (surface_.polygon_island[from->polygon] != surface_.polygon_island[to->polygon]) {
    path.reason = Reason::kOtherIsland;
    return path;
  }
  if (metric == Metric::kExact) throw Error("metric 'exact' is not built yet; ask for 'detour'");
  path.points = detour_path(mesh_, *from, *to, metric == Metric::kDetour);
  if (path.points.empty()) {
    path.reason = Reason::kSearchLimit;
  } else {
    path.length = polyline_length(path.points);
  }
  return path;
}

}  // namespace wiw::nav
