// SPDX-License-Identifier: Apache-2.0
#include "wiw/nav/geodesics.hpp"

#include <algorithm>
#include <limits>

namespace wiw::nav {
namespace {

constexpr double kInfinity = std::numeric_limits<double>::infinity();
constexpr auto kIgnoreCones = [](const Cone&) {};

}  // namespace

Geodesics::Geodesics(const PolygonGraph& graph)
    : graph_(graph), corners_(find_corners(graph)), corner_graph_(graph, corners_) {}

Site Geodesics::site(const MeshPoint& projection) const {
  constexpr double kMargin = 2e-4;  // units: above the single-precision error of a coordinate 100 m out
  const Point2 at = graph_.to_plane(projection.point);
  return {projection.polygon, at, graph_.inside(projection.polygon, at, kMargin)};
}

Geodesics::Way Geodesics::way(const Site& start, const Site& end) const {
  bool seen = start.polygon == end.polygon;
  std::vector<CornerDistance> legs;
  Sight sight(graph_, corners_);
  sight.from_site(
      start, [&](int c) { legs.push_back(leg(c, start.at)); },
      [&](const Cone& cone) { seen = seen || (cone.polygon == end.polygon && cone.contains(end.eye - start.eye)); });
  if (seen) return {metres(start.at, end.at), {}};
  std::vector<double> from_start(corners_.list.size());
  std::vector<std::int32_t> parents;
  corner_graph_.find_distances(legs, from_start, &parents);
  Way way{kInfinity, {}};
  int last = -1;
  const auto arrive = [&](int c) {
    const double length = from_start[c] + leg(c, end.at).metres;
    if (length >= way.metres) return;
    way.metres = length;
    last = c;
  };
  sight.from_site(end, arrive, kIgnoreCones);
  for (; last >= 0; last = parents[last]) way.corners.push_back(last);
  std::reverse(way.corners.begin(), way.corners.end());
  return way;
}

GoalSearch::GoalSearch(const Geodesics& geodesics, std::vector<Site> goals)
    : geodesics_(geodesics), goals_(std::move(goals)), corner_metres_(geodesics.corners().list.size()) {
  std::sort(goals_.begin(), goals_.end(), [](const Site& a, const Site& b) { return a.polygon < b.polygon; });
  std::vector<CornerDistance> legs;
  Sight sight(geodesics.graph(), geodesics.corners());
  for (const Site& goal : goals_) {
    sight.from_site(goal, [&](int c) { legs.push_back(geodesics.leg(c, goal.at)); }, kIgnoreCones);
  }
  geodesics.corner_graph().find_distances(legs, corner_metres_);
}

double GoalSearch::nearest_goal(const Site& site, int polygon, const Cone* cone) const {
  double best = kInfinity;
  auto goal = std::lower_bound(goals_.begin(), goals_.end(), polygon,
                               [](const Site& candidate, int value) { return candidate.polygon < value; });
  for (; goal != goals_.end() && goal->polygon == polygon; ++goal) {
    if (!cone || cone->contains(goal->eye - site.eye)) best = std::min(best, geodesics_.metres(site.at, goal->at));
  }
  return best;
}

double GoalSearch::metres(const Site& site) const {
  double best = nearest_goal(site, site.polygon, nullptr);
  Sight sight(geodesics_.graph(), geodesics_.corners());
  sight.from_site(
      site, [&](int c) { best = std::min(best, corner_metres_[c] + geodesics_.leg(c, site.at).metres); },
      [&](const Cone& cone) { best = std::min(best, nearest_goal(site, cone.polygon, &cone)); });
  return best;
}

}  // namespace wiw::nav
