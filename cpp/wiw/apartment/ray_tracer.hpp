// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <embree3/rtcore.h>

#include <array>
#include <cstddef>
#include <vector>

#include "wiw/apartment/shape.hpp"

namespace wiw::apartment {

/// Where a ray ends: triangle number (-1: nowhere) and barycentric coordinates of its second and third corner.
struct Hit {
  std::int32_t triangle = -1;
  float u = 0.f, v = 0.f, distance = 0.f;
};

/// One vector for each of the sixteen rays that are traced together, by coordinate.
struct Vec3x16 {
  static constexpr std::size_t kCount = 16;
  using Row = std::array<float, kCount>;
  alignas(64) Row x, y, z;

  [[nodiscard]] Vec3 operator[](std::size_t i) const { return {x[i], y[i], z[i]}; }
};

/// Sixteen rays from one point against a fixed triangle soup.
class RayTracer {
 public:
  static constexpr std::size_t kWidth = Vec3x16::kCount;

  RayTracer(std::vector<Vec3> vertices, std::vector<scene::Triangle> triangles);
  ~RayTracer();
  RayTracer(const RayTracer&) = delete;
  RayTracer& operator=(const RayTracer&) = delete;

  /// Which of the active segments origin + (0, 1] * direction are blocked.
  [[nodiscard]] std::array<bool, kWidth> blocked(const Vec3& origin, const Vec3x16& directions,
                                                 const std::array<bool, kWidth>& active) const;
  [[nodiscard]] std::array<Hit, kWidth> trace(const Vec3& origin, const Vec3x16& directions) const;

 private:
  std::vector<Vec3> vertices_;
  std::vector<scene::Triangle> triangles_;
  RTCDevice device_ = nullptr;
  RTCScene scene_ = nullptr;
  bool wide_ = false;  // whether this CPU traces sixteen rays at once, and not eight
};

}  // namespace wiw::apartment
