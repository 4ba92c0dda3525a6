// SPDX-License-Identifier: Apache-2.0
#include "wiw/nav/distance_field.hpp"

#include <algorithm>
#include <cmath>
#include <limits>
#include <string>

#include "wiw/core/error.hpp"

namespace wiw::nav {

DistanceField::DistanceField(std::shared_ptr<const NavMesh> mesh, std::span<const Eigen::Vector3f> goals)
    : mesh_(std::move(mesh)) {
  if (goals.empty()) throw ArgumentError("expected at least one goal, got none");
  std::vector<Site> sites;
  for (std::size_t i = 0; i < goals.size(); ++i) {
    const auto projection = mesh_->project(goals[i]);
    if (!projection) {
      throw NavigationError("goal " + std::to_string(i) +
                            " is off the mesh: expected a place within 2 m sideways and 4 m up or down of it");
    }
    sites.push_back(mesh_->geodesics().site(*projection));
    islands_.push_back(mesh_->surface().polygon_island[projection->polygon]);
  }
  search_ = std::make_unique<const GoalSearch>(mesh_->geodesics(), std::move(sites));
}

Distance DistanceField::distance(const Eigen::Vector3f& point) const {
  constexpr double kInfinity = std::numeric_limits<double>::infinity();
  const auto projection = mesh_->project(point);
  if (!projection) return {kInfinity, NoPathReason::kStartOffMesh};
  const int island = mesh_->surface().polygon_island[projection->polygon];
  if (std::find(islands_.begin(), islands_.end(), island) == islands_.end())
    return {kInfinity, NoPathReason::kOtherIsland};
  const double metres = search_->metres(mesh_->geodesics().site(*projection));
  return {metres, std::isfinite(metres) ? NoPathReason::kNone : NoPathReason::kDisconnected};
}

}  // namespace wiw::nav
