// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <Eigen/Core>
#include <cstdint>
#include <vector>

namespace wiw::test {

/// Triangles added box by box; enough to build rooms.
struct Soup {
  std::vector<Eigen::Vector3f> vertices;
  std::vector<Eigen::Matrix<std::uint32_t, 3, 1>> triangles;

  void quad(const Eigen::Vector3f& a, const Eigen::Vector3f& b, const Eigen::Vector3f& c, const Eigen::Vector3f& d) {
    const auto base = static_cast<std::uint32_t>(vertices.size());
    vertices.insert(vertices.end(), {a, b, c, d});
    triangles.push_back({base, base + 1, base + 2});
    triangles.push_back({base, base + 2, base + 3});
  }
  /// Level floor [x0, x1] x [z0, z1] at height y, facing up.
  void floor(float x0, float z0, float x1, float z1, float y = 0) {
    quad({x0, y, z0}, {x0, y, z1}, {x1, y, z1}, {x1, y, z0});
  }
  /// Ramp along x from height y0 at x0 to y1 at x1, facing up.
  void ramp(float x0, float z0, float x1, float z1, float y0, float y1) {
    quad({x0, y0, z0}, {x0, y0, z1}, {x1, y1, z1}, {x1, y1, z0});
  }
  /// Block standing on y = 0; too low inside for an agent of 1.5 m.
  void block(float x0, float z0, float x1, float z1, float height = 1.2f) {
    quad({x0, 0, z0}, {x0, height, z0}, {x1, height, z0}, {x1, 0, z0});
    quad({x0, 0, z1}, {x1, 0, z1}, {x1, height, z1}, {x0, height, z1});
    quad({x0, 0, z0}, {x0, 0, z1}, {x0, height, z1}, {x0, height, z0});
    quad({x1, 0, z0}, {x1, height, z0}, {x1, height, z1}, {x1, 0, z1});
    floor(x0, z0, x1, z1, height);
  }
};

}  // namespace wiw::test
