// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <Eigen/Geometry>
#include <memory>
#include <mutex>
#include <optional>
#include <span>
#include <string>
#include <vector>

#include "wiw/nav/detour_mesh.hpp"
#include "wiw/nav/geodesics.hpp"
#include "wiw/nav/settings.hpp"
#include "wiw/nav/surface.hpp"
#include "wiw/scene/scene.hpp"

namespace wiw::nav {

/// How the length of a path is measured.
enum class Metric {
  kExact,           // shortest path over the mesh, horizontal length
  kDetour,          // Habitat's answer, 3D length, with its limits of 256 polygons and 2048 nodes
  kDetourUncapped,  // the same search without those limits
};

/// Why there is no path.
enum class NoPathReason { kNone, kStartOffMesh, kEndOffMesh, kOtherIsland, kSearchLimit, kDisconnected };
const char* reason_text(NoPathReason reason);

struct Distance {
  double metres = 0;  // infinite unless reason is kNone
  NoPathReason reason = NoPathReason::kNone;
};

/// The corners of a path, start and end included; points lie on the mesh.
struct Path {
  std::vector<Eigen::Vector3f> points;
  double length = 0;  // metres, in the sense of the metric asked for
  NoPathReason reason = NoPathReason::kNone;
};

/// Where an agent can stand, for one body size. Immutable; const methods may be called from any thread.
class NavMesh {
 public:
  /// Throws ArgumentError if nothing is walkable.
  static std::shared_ptr<NavMesh> build(const scene::Scene& scene, const NavMeshSettings& settings = {});
  static std::shared_ptr<NavMesh> from_triangles(std::span<const Eigen::Vector3f> vertices,
                                                 std::span<const Eigen::Matrix<std::uint32_t, 3, 1>> triangles,
                                                 const NavMeshSettings& settings = {});
  /// Habitat `.navmesh` files of versions 1 and 2. Throws FileError naming file and cause.
  static std::shared_ptr<NavMesh> load(const std::string& path);
  void save(const std::string& path, int version = 2) const;

  [[nodiscard]] const NavMeshSettings& settings() const { return settings_; }
  [[nodiscard]] const Surface& surface() const { return surface_; }
  [[nodiscard]] Eigen::AlignedBox3f bounds() const;
  [[nodiscard]] double area() const { return surface_.area(); }

  /// Nearest point on the mesh, searched 2 m sideways and 4 m up and down; empty if there is none.
  [[nodiscard]] std::optional<Eigen::Vector3f> snap(const Eigen::Vector3f& point) const;
  /// Index into surface().islands of the island nearest to the point, -1 off the mesh.
  [[nodiscard]] int island_of(const Eigen::Vector3f& point) const;
  /// On the mesh within `max_dy` vertically and 1 cm horizontally.
  [[nodiscard]] bool is_navigable(const Eigen::Vector3f& point, float max_dy = 0.5f) const;

  /// Uniform over the surface of one island (0 is the largest; -1: all of them), a function of the seed alone.
  [[nodiscard]] std::vector<Eigen::Vector3f> sample(std::size_t count, std::uint64_t seed, int island = 0) const;

  /// Where an agent that walks straight from `start` towards `end` comes to stand: at walls it slides along or stops.
  /// Returns `start` unchanged if either point is off the mesh or they lie on different islands.
  [[nodiscard]] Eigen::Vector3f try_step(const Eigen::Vector3f& start, const Eigen::Vector3f& end,
                                         bool sliding = true) const;

  [[nodiscard]] Distance geodesic_distance(const Eigen::Vector3f& start, const Eigen::Vector3f& end,
                                           Metric metric = Metric::kExact) const;
  [[nodiscard]] Path shortest_path(const Eigen::Vector3f& start, const Eigen::Vector3f& end,
                                   Metric metric = Metric::kExact) const;
  /// Row-major [n, n] metres between all pairs, infinite where there is no path. kExact is symmetric; the Detour
  /// metrics are asked once for each ordered pair.
  [[nodiscard]] std::vector<double> distance_matrix(std::span<const Eigen::Vector3f> points,
                                                    Metric metric = Metric::kExact) const;

  /// Metres of a polyline laid onto the surface, climbs included: heights are followed in steps of at most `step`.
  /// Points and lines are projected, so a line that leaves the mesh is measured along its edge.
  [[nodiscard]] double surface_length(std::span<const Eigen::Vector3f> points, float step = 0.05f) const;

  [[nodiscard]] std::optional<MeshPoint> project(const Eigen::Vector3f& point) const { return mesh_.project(point); }
  /// The exact metric's visibility graph, made at the first call.
  [[nodiscard]] const Geodesics& geodesics() const;

 private:
  struct Ends {
    MeshPoint start, end;
    NoPathReason reason = NoPathReason::kNone;
  };
  NavMesh(std::vector<std::uint8_t> tile, const NavMeshSettings& settings);
  [[nodiscard]] Ends project_ends(const Eigen::Vector3f& start, const Eigen::Vector3f& end) const;
  [[nodiscard]] Path exact_path(const MeshPoint& start, const MeshPoint& end) const;

  NavMeshSettings settings_;
  DetourMesh mesh_;
  Surface surface_;
  PolygonGraph graph_;
  mutable std::once_flag geodesics_made_;
  mutable std::unique_ptr<const Geodesics> geodesics_;
};

}  // namespace wiw::nav
