// SPDX-License-Identifier: Apache-2.0
#include "wiw/nav/nav_mesh.hpp"

#include <algorithm>
#include <cmath>
#include <limits>

#include "wiw/core/error.hpp"
#include "wiw/core/rng.hpp"
#include "wiw/core/thread_pool.hpp"
#include "wiw/nav/detour_path.hpp"
#include "wiw/nav/navmesh_file.hpp"
#include "wiw/nav/recast_build.hpp"
#include "wiw/nav/step.hpp"

namespace wiw::nav {

const char* reason_text(NoPathReason reason) {
  switch (reason) {
    case NoPathReason::kNone: return "";
    case NoPathReason::kStartOffMesh: return "start off mesh";
    case NoPathReason::kEndOffMesh: return "end off mesh";
    case NoPathReason::kOtherIsland: return "other island";
    case NoPathReason::kSearchLimit: return "search limit of 256 polygons or 2048 nodes";
    case NoPathReason::kDisconnected: return "disconnected mesh";
  }
  return "";
}

NavMesh::NavMesh(std::vector<std::uint8_t> tile, const NavMeshSettings& settings)
    : settings_(settings),
      mesh_(std::move(tile)),
      surface_(extract_surface(mesh_)),
      graph_(mesh_, surface_.polygon_island) {}

std::shared_ptr<NavMesh> NavMesh::from_triangles(std::span<const Eigen::Vector3f> vertices,
                                                 std::span<const Eigen::Matrix<std::uint32_t, 3, 1>> triangles,
                                                 const NavMeshSettings& settings) {
  std::shared_ptr<NavMesh> mesh(new NavMesh(build_tile(vertices, triangles, settings), settings));
  if (mesh->surface_.islands.empty()) throw ArgumentError("every walkable polygon is smaller than 1e-5 m2");
  return mesh;
}

std::shared_ptr<NavMesh> NavMesh::build(const scene::Scene& scene, const NavMeshSettings& settings) {
  const scene::TriangleSoup soup = scene::world_triangles(scene);
  return from_triangles(soup.vertices, soup.triangles, settings);
}

std::shared_ptr<NavMesh> NavMesh::load(const std::string& path) {
  NavMeshFile file = read_navmesh(path);
  std::shared_ptr<NavMesh> mesh(new NavMesh(std::move(file.tile), file.settings));
  if (mesh->surface_.islands.empty()) throw FileError(path, "holds no polygon that is walkable");
  return mesh;
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

NavMesh::Ends NavMesh::project_ends(const Eigen::Vector3f& start, const Eigen::Vector3f& end) const {
  const auto from = mesh_.project(start);
  const auto to = mesh_.project(end);
  if (!from) return {.reason = NoPathReason::kStartOffMesh};
  if (!to) return {.reason = NoPathReason::kEndOffMesh};
  const bool connected = surface_.polygon_island[from->polygon] == surface_.polygon_island[to->polygon];
  return {*from, *to, connected ? NoPathReason::kNone : NoPathReason::kOtherIsland};
}

Eigen::Vector3f NavMesh::try_step(const Eigen::Vector3f& start, const Eigen::Vector3f& end, bool sliding) const {
  const Ends ends = project_ends(start, end);
  return ends.reason == NoPathReason::kNone ? walk(mesh_, graph_, surface_.polygon_island, ends.start, end, sliding)
                                            : start;
}

const Geodesics& NavMesh::geodesics() const {
  std::call_once(geodesics_made_, [this] { geodesics_ = std::make_unique<const Geodesics>(graph_); });
  return *geodesics_;
}

Distance NavMesh::geodesic_distance(const Eigen::Vector3f& start, const Eigen::Vector3f& end, Metric metric) const {
  const Path path = shortest_path(start, end, metric);
  return {path.length, path.reason};
}

Path NavMesh::exact_path(const MeshPoint& start, const MeshPoint& end) const {
  const Geodesics& exact = geodesics();
  const Geodesics::Way way = exact.way(exact.site(start), exact.site(end));
  // Islands go by the links of the file, where a side may lead one way only; such a side is a wall to exact paths.
  if (!std::isfinite(way.metres)) return {.length = way.metres, .reason = NoPathReason::kDisconnected};
  Path path{.points = {start.point}, .length = way.metres};
  for (const int corner : way.corners) {
    path.points.emplace_back(mesh_.tile().verts + 3 * exact.corners().list[corner].vertex);
  }
  path.points.push_back(end.point);
  return path;
}

Path NavMesh::shortest_path(const Eigen::Vector3f& start, const Eigen::Vector3f& end, Metric metric) const {
  constexpr double kInfinity = std::numeric_limits<double>::infinity();
  const Ends ends = project_ends(start, end);
  if (ends.reason != NoPathReason::kNone) return {.length = kInfinity, .reason = ends.reason};
  if (metric == Metric::kExact) return exact_path(ends.start, ends.end);
  Path path{.points = detour_path(mesh_, ends.start, ends.end, metric == Metric::kDetour)};
  if (path.points.empty()) return {.length = kInfinity, .reason = NoPathReason::kSearchLimit};
  path.length = polyline_length(path.points);
  return path;
}

std::vector<double> NavMesh::distance_matrix(std::span<const Eigen::Vector3f> points, Metric metric) const {
  const std::size_t n = points.size();
  std::vector<double> metres(n * n, std::numeric_limits<double>::infinity());
  if (metric != Metric::kExact) {
    parallel_for(n, [&](std::size_t i) {
      for (std::size_t j = 0; j < n; ++j) metres[i * n + j] = geodesic_distance(points[i], points[j], metric).metres;
    });
    return metres;
  }
  std::vector<Site> sites;
  std::vector<std::size_t> place;  // of each site among the points
  for (std::size_t i = 0; i < n; ++i) {
    const auto projection = mesh_.project(points[i]);
    if (!projection) continue;
    sites.push_back(geodesics().site(*projection));
    place.push_back(i);
  }
  if (sites.size() == n) {
    geodesics().matrix(sites, metres);
    return metres;
  }
  std::vector<double> on_mesh(sites.size() * sites.size());
  geodesics().matrix(sites, on_mesh);
  for (std::size_t i = 0; i < sites.size(); ++i) {
    for (std::size_t j = 0; j < sites.size(); ++j) metres[place[i] * n + place[j]] = on_mesh[i * sites.size() + j];
  }
  return metres;
}

double NavMesh::surface_length(std::span<const Eigen::Vector3f> points, float step) const {
  if (!(step > 0)) throw ArgumentError("expected a positive step, got " + std::to_string(step));
  for (std::size_t i = 0; i < points.size(); ++i) {
    if (!points[i].allFinite()) throw ArgumentError("expected finite points, got point " + std::to_string(i));
  }
  const auto on_surface = [&](const Eigen::Vector3f& point) { return snap(point).value_or(point); };
  double metres = 0;
  for (std::size_t i = 1; i < points.size(); ++i) {
    Eigen::Vector3f from = on_surface(points[i - 1]);
    const Eigen::Vector3f end = on_surface(points[i]);
    const int steps = static_cast<int>(std::ceil(std::min(1e6f, (end - from).norm() / step)));
    const Eigen::Vector3f start = from;
    for (int k = 1; k <= steps; ++k) {
      Eigen::Vector3f to = start + (end - start) * (static_cast<float>(k) / static_cast<float>(steps));
      to.y() = from.y();  // the search for the surface begins where the walk is, not on the chord
      to = on_surface(to);
      metres += (to - from).norm();
      from = to;
    }
  }
  return metres;
}

}  // namespace wiw::nav
