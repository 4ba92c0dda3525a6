// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstdint>
#include <vector>

#include "wiw/nav/corners.hpp"
#include "wiw/nav/expansion.hpp"

namespace wiw::nav {

/// A point of the mesh as the exact metric sees it.
struct Site {
  int polygon = -1;
  Point2 at;   // for lengths
  Point2 eye;  // for sight: strictly inside the polygon
};

/// Finds the corners at which shortest paths from a point or corner can bend first. One object a thread.
class Sight {
 public:
  Sight(const PolygonGraph& graph, const Corners& corners)
      : graph_(graph), corners_(corners), expansion_(graph), stamp_(corners.list.size(), 0) {}

  /// see(c) for every corner seen from `site` at which a path may bend; cone(c) for every cone of sight, so that the
  /// caller can look for its own targets. Everything in the site's own polygon is seen without a cone.
  template <class See, class OnCone>
  void from_site(const Site& site, See&& see, OnCone&& on_cone) {
    ++now_;
    see_polygon(site.polygon, site.eye, see);
    expansion_.from_inside(site.polygon, site.eye, [&](const Cone& cone) {
      see_cone(cone, site.eye, see);
      on_cone(cone);
    });
  }

  template <class See>
  void from_corner(int corner, See&& see) {
    ++now_;
    stamp_[corner] = now_;
    const Corner& c = corners_.list[corner];
    for (const auto& [polygon, place] : c.fan) {
      see_polygon(polygon, c.at, see);
      expansion_.from_corner(polygon, place, [&](const Cone& cone) { see_cone(cone, c.at, see); });
    }
  }

 private:
  template <class See>
  void see_corner(int corner, Point2 eye, See&& see) {
    if (corner < 0 || stamp_[corner] == now_) return;
    stamp_[corner] = now_;
    if (corners_.list[corner].is_taut(eye)) see(corner);
  }

  template <class See>
  void see_polygon(int polygon, Point2 eye, See&& see) {
    for (int k = 0; k < graph_.polygons()[polygon].sides; ++k) see_corner(corners_.of[polygon][k], eye, see);
  }

  // The two ends of the entry side belong to the polygon before.
  template <class See>
  void see_cone(const Cone& cone, Point2 eye, See&& see) {
    const Polygon& p = graph_.polygons()[cone.polygon];
    for (int k = p.after(p.after(cone.entry)); k != cone.entry; k = p.after(k)) {
      if (corners_.of[cone.polygon][k] >= 0 && cone.contains(p.at[k] - eye)) {
        see_corner(corners_.of[cone.polygon][k], eye, see);
      }
    }
  }

  const PolygonGraph& graph_;
  const Corners& corners_;
  Expansion expansion_;
  std::vector<std::uint32_t> stamp_;
  std::uint32_t now_ = 0;
};

}  // namespace wiw::nav
