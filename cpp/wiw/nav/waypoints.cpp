// SPDX-License-Identifier: Apache-2.0
#include "wiw/nav/waypoints.hpp"

#include <algorithm>
#include <cmath>
#include <numeric>

#include "wiw/core/error.hpp"

namespace wiw::nav {
namespace {

void check_options(const WaypointOptions& options) {
  if (!std::isfinite(options.mean_weight) || std::isnan(options.spacing)) {
    throw ArgumentError("expected a finite mean_weight and a spacing in metres, got " +
                        std::to_string(options.mean_weight) + " and " + std::to_string(options.spacing));
  }
}

std::size_t count_samples(double area, const WaypointOptions& options) {
  constexpr std::size_t kMost = std::size_t{1} << 20;  // the distances between so many take 8 TiB
  const double by_area = options.density * area;
  if (!(by_area >= 0 && by_area <= kMost) || options.min_samples > kMost) {
    throw ArgumentError("expected a density and min_samples that make at most " + std::to_string(kMost) +
                        " samples, got density " + std::to_string(options.density) + " on " + std::to_string(area) +
                        " m2 and min_samples " + std::to_string(options.min_samples));
  }
  return std::max(options.min_samples, static_cast<std::size_t>(by_area));
}

double leaf_score(std::span<const double> row, double mean_weight) {
  const double others = std::max<double>(1, static_cast<double>(row.size()) - 1);
  const double mean = std::accumulate(row.begin(), row.end(), 0.0) / others;
  return *std::max_element(row.begin(), row.end()) + mean_weight * mean;
}

}  // namespace

RankedPlaces select_waypoints(std::span<const double> metres, std::size_t count, const WaypointOptions& options) {
  check_options(options);
  if (metres.size() != count * count) {
    throw ArgumentError("expected " + std::to_string(count * count) + " distances, got " +
                        std::to_string(metres.size()));
  }
  if (!std::all_of(metres.begin(), metres.end(), [](double d) { return std::isfinite(d); })) {
    throw ArgumentError("expected finite distances: all places must lie on one island and within the metric's reach");
  }
  std::vector<double> score(count);
  for (std::size_t i = 0; i < count; ++i) score[i] = leaf_score(metres.subspan(i * count, count), options.mean_weight);
  std::vector<std::size_t> order(count);
  std::iota(order.begin(), order.end(), std::size_t{0});
  std::stable_sort(order.begin(), order.end(), [&](std::size_t a, std::size_t b) { return score[a] > score[b]; });
  RankedPlaces chosen;
  for (const std::size_t i : order) {
    const auto far = [&](std::size_t other) { return metres[i * count + other] >= options.spacing; };
    if (!std::all_of(chosen.index.begin(), chosen.index.end(), far)) continue;
    chosen.index.push_back(i);
    chosen.score.push_back(score[i]);
  }
  return chosen;
}

std::vector<Eigen::Vector3f> select_waypoints(const NavMesh& mesh, std::uint64_t seed, const WaypointOptions& options) {
  check_options(options);
  const auto samples = mesh.sample(count_samples(mesh.surface().islands[0].area, options), seed);
  const auto metres = mesh.distance_matrix(samples, options.metric);
  std::vector<Eigen::Vector3f> points;
  for (const std::size_t i : select_waypoints(metres, samples.size(), options).index) points.push_back(samples[i]);
  return points;
}

}  // namespace wiw::nav
