// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cmath>

namespace wiw::nav {

/// Point or vector of the horizontal plane (x, z), in grid units of the mesh.
struct Point2 {
  double x = 0, y = 0;
  friend Point2 operator+(Point2 a, Point2 b) { return {a.x + b.x, a.y + b.y}; }
  friend Point2 operator-(Point2 a, Point2 b) { return {a.x - b.x, a.y - b.y}; }
  friend Point2 operator*(double s, Point2 a) { return {s * a.x, s * a.y}; }
  bool operator==(const Point2&) const = default;
};

inline double cross(Point2 a, Point2 b) { return a.x * b.y - a.y * b.x; }
inline double dot(Point2 a, Point2 b) { return a.x * b.x + a.y * b.y; }
inline double length(Point2 a) { return std::sqrt(dot(a, a)); }

/// Twice the area of triangle abc: positive if c lies left of the line from a to b. Exact for integers below 2^25.
inline double orient(Point2 a, Point2 b, Point2 c) { return cross(b - a, c - a); }

}  // namespace wiw::nav
