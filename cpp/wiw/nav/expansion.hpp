// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <vector>

#include "wiw/nav/polygon_graph.hpp"

namespace wiw::nav {

/// A cone of sight from an apex, clipped to the side through which it enters a polygon. Its edges are kept as vectors
/// from the apex to the vertices that limit it, so that no intersection point is ever computed and tests between
/// vertices stay exact.
struct Cone {
  Point2 right, left;
  int polygon = -1;
  int entry = -1;  // side of the polygon the cone came in by
  int depth = 0;

  [[nodiscard]] bool contains(Point2 ray) const { return cross(right, ray) >= 0 && cross(ray, left) >= 0; }
};

/// Everything seen from one point: sight spreads from polygon to polygon through common sides, in disjoint cones
/// (triangular expansion, Bungiu et al. 2014). Keeps its stack between calls; one object a thread.
class Expansion {
 public:
  explicit Expansion(const PolygonGraph& graph) : graph_(graph) {}

  /// Sees from a point strictly inside `polygon`, which itself is left to the caller: all of it is seen.
  /// visit(cone) is called for every cone that enters a polygon.
  template <class Visit>
  void from_inside(int polygon, Point2 apex, Visit&& visit) {
    apex_ = apex;
    const Polygon& p = graph_.polygons()[polygon];
    for (int k = 0; k < p.sides; ++k) enter(p, k, p.at[k] - apex_, p.at[p.after(k)] - apex_, 1);
    run(visit);
  }

  /// Sees from corner `place` of `polygon` across the sides of that polygon which do not touch it.
  template <class Visit>
  void from_corner(int polygon, int place, Visit&& visit) {
    const Polygon& p = graph_.polygons()[polygon];
    apex_ = p.at[place];
    for (int k = p.after(place); k != p.before(place); k = p.after(k)) {
      enter(p, k, p.at[k] - apex_, p.at[p.after(k)] - apex_, 1);
    }
    run(visit);
  }

 private:
  void enter(const Polygon& polygon, int side, Point2 right, Point2 left, int depth) {
    if (polygon.next[side] < 0 || cross(right, left) <= 0) return;
    stack_.push_back({right, left, polygon.next[side], polygon.back[side], depth});
  }

  template <class Visit>
  void run(Visit&& visit) {
    // A straight line meets a convex polygon once; the bound only matters where a damaged file overlaps itself.
    const int max_depth = static_cast<int>(graph_.polygons().size());
    while (!stack_.empty()) {
      const Cone cone = stack_.back();
      stack_.pop_back();
      visit(cone);
      if (cone.depth < max_depth) spread(cone);
    }
  }

  // The far sides run from right to left as seen from the apex.
  void spread(const Cone& cone) {
    const Polygon& p = graph_.polygons()[cone.polygon];
    int k = p.after(cone.entry);
    Point2 from = p.at[k] - apex_;
    for (int n = 2; n <= p.sides; ++n) {
      const int next = p.after(k);
      const Point2 to = p.at[next] - apex_;
      if (p.next[k] >= 0 && cross(cone.right, to) > 0 && cross(from, cone.left) > 0) {
        const Point2 right = cross(cone.right, from) > 0 ? from : cone.right;
        const Point2 left = cross(to, cone.left) > 0 ? to : cone.left;
        enter(p, k, right, left, cone.depth + 1);
      }
      k = next;
      from = to;
    }
  }

  const PolygonGraph& graph_;
  Point2 apex_;
  std::vector<Cone> stack_;
};

}  // namespace wiw::nav
