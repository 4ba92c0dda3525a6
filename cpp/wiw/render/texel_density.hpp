// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <Eigen/Geometry>
#include <algorithm>
#include <cmath>

namespace wiw::render {

/// Largest number of texels that a metre of a triangle's plane covers in any direction: the largest singular value of
/// d(texel)/d(metre). Edges from vertex 0 in metres and in texels. 1 for triangles without area, which no ray hits.
inline float texel_density(const Eigen::Vector3f& edge_1, const Eigen::Vector3f& edge_2,
                           const Eigen::Vector2f& texels_1, const Eigen::Vector2f& texels_2) {
  const float length = edge_1.norm();
  const float along = length > 0.f ? edge_1.dot(edge_2) / length : 0.f;
  const float across = std::sqrt(std::max(0.f, edge_2.squaredNorm() - along * along));
  if (!(length * across > 0.f)) return 1.f;
  // Columns of the Jacobian in the orthonormal frame (edge_1, its perpendicular).
  const Eigen::Vector2f x = texels_1 / length;
  const Eigen::Vector2f y = (texels_2 - x * along) / across;
  const float half_trace = 0.5f * (x.squaredNorm() + y.squaredNorm());
  const float half_gap = 0.5f * (x.squaredNorm() - y.squaredNorm());
  const float dot = x.dot(y);
  const float density = std::sqrt(half_trace + std::sqrt(half_gap * half_gap + dot * dot));
  return std::isfinite(density) ? std::max(density, 1e-20f) : 1.f;
}

}  // namespace wiw::render
