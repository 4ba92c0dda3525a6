// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <span>
#include <vector>

#include "wiw/nav/corner_graph.hpp"
#include "wiw/nav/corners.hpp"
#include "wiw/nav/polygon_graph.hpp"

namespace wiw::nav {

/// Exact shortest paths over the mesh, measured horizontally. A shortest path is straight except at corners around
/// which it is taut, so it is a shortest path of the corners' visibility graph between the corners that its ends see.
class Geodesics {
 public:
  /// Keeps a reference to the graph.
  explicit Geodesics(const PolygonGraph& graph);

  [[nodiscard]] const PolygonGraph& graph() const { return graph_; }
  [[nodiscard]] const Corners& corners() const { return corners_; }
  [[nodiscard]] const CornerGraph& corner_graph() const { return corner_graph_; }

  [[nodiscard]] Site site(const MeshPoint& projection) const;
  [[nodiscard]] double metres(Point2 a, Point2 b) const { return graph_.scale() * length(b - a); }
  [[nodiscard]] CornerDistance leg(int corner, Point2 from) const {
    return {corner, metres(from, corners_.list[corner].at)};
  }

  struct Way {
    double metres = 0;         // infinite if there is none
    std::vector<int> corners;  // bends, in order
  };
  [[nodiscard]] Way way(const Site& start, const Site& end) const;

  /// Row-major [n, n] metres between all pairs; symmetric, zero on the diagonal, infinite where there is no path.
  void matrix(std::span<const Site> sites, std::span<double> metres) const;

 private:
  const PolygonGraph& graph_;
  Corners corners_;
  CornerGraph corner_graph_;
};

/// Distances to the nearest of fixed goals: what they see and the paths from there to all corners are computed once.
class GoalSearch {
 public:
  /// Keeps a reference to the geodesics.
  GoalSearch(const Geodesics& geodesics, std::vector<Site> goals);
  [[nodiscard]] double metres(const Site& site) const;

 private:
  /// Nearest goal of one polygon, within the cone if there is one.
  [[nodiscard]] double nearest_goal(const Site& site, int polygon, const Cone* cone) const;

  const Geodesics& geodesics_;
  std::vector<Site> goals_;            // sorted by polygon
  std::vector<double> corner_metres_;  // from each corner to its nearest goal
};

}  // namespace wiw::nav
