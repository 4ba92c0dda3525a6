// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <Eigen/Geometry>
#include <algorithm>
#include <array>
#include <cmath>

namespace wiw::render {

/// How far the curved surface that the unit vertex normals describe stands out of the triangle, metres: the greatest
/// depth of a vertex below the tangent plane of another. 0 where the surface is flat or hollow, and for normals more
/// than 37 degrees off the triangle's own, which smooth over an edge and describe no surface.
inline float triangle_bulge(const std::array<Eigen::Vector3f, 3>& corners,
                            const std::array<Eigen::Vector3f, 3>& normals) {
  constexpr float kLeastCosine = 0.8f;
  const Eigen::Vector3f face = (corners[1] - corners[0]).cross(corners[2] - corners[0]).normalized();
  float bulge = 0.f;
  for (std::size_t i = 0; i < 3; ++i) {
    // Windings are not to be relied on. A triangle without area has no face normal and no bulge.
    if (!(std::abs(face.dot(normals[i])) > kLeastCosine)) return 0.f;
    for (std::size_t j = 0; j < 3; ++j) bulge = std::max(bulge, normals[i].dot(corners[i] - corners[j]));
  }
  return bulge;
}

}  // namespace wiw::render
