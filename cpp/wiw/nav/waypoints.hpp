// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <span>
#include <vector>

#include "wiw/nav/nav_mesh.hpp"

namespace wiw::nav {

/// Stage 1 of the dataset construction of the World-in-World paper (its Algorithm 1): places at the periphery, spread
/// out.
struct WaypointOptions {
  double density = 4;              // samples per m2 of walkable surface
  std::size_t min_samples = 1400;  // samples drawn at least
  double mean_weight = 1.7;        // alpha: leaf score = eccentricity + alpha x mean distance
  double spacing = 3;              // r_f, metres between chosen places
  Metric metric = Metric::kExact;
};

/// From a row-major [n, n] matrix of finite distances: places in descending order of leaf score of which no two are
/// closer than `spacing`, chosen greedily. Ties go to the lower index. Throws ArgumentError for options that are no
/// numbers.
struct RankedPlaces {
  std::vector<std::size_t> index;
  std::vector<double> score;
};
RankedPlaces select_waypoints(std::span<const double> metres, std::size_t count, const WaypointOptions& options);

/// Draws max(min_samples, density x area) points on the largest island and selects among them.
std::vector<Eigen::Vector3f> select_waypoints(const NavMesh& mesh, std::uint64_t seed, const WaypointOptions& options);

}  // namespace wiw::nav
