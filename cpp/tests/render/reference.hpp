// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <vector>

#include "wiw/render/mipmap.hpp"
#include "wiw/render/renderer.hpp"

namespace wiw::testing {

/// Slow twin of the renderer: every ray against every triangle, in double precision, shaded by the documented formulas.
class Reference {
 public:
  explicit Reference(const scene::Scene& scene);

  struct Sample {
    double depth = 0;
    std::uint32_t instance = 0;
    Eigen::Vector3d color = Eigen::Vector3d::Zero();  // [0, 255]
    bool doubtful = false;  // so near to an edge, a crease of the sky or another surface that rounding may decide
  };
  /// `ray` scaled as shading.hpp says; `spread` is the width of a pixel at depth 1.
  [[nodiscard]] Sample cast(const Eigen::Vector3d& origin, const Eigen::Vector3d& ray, double spread) const;

 private:
  struct Hit {
    const scene::Mesh* mesh = nullptr;
    const scene::Instance* instance = nullptr;
    std::size_t triangle = 0;
    double t = 0, b1 = 0, b2 = 0;
    Eigen::Vector3d point, edge_1, edge_2;
  };
  [[nodiscard]] std::vector<Hit> all_hits(const Eigen::Vector3d& origin, const Eigen::Vector3d& ray, double slack,
                                          double nearest) const;
  [[nodiscard]] bool is_hole(const Hit& hit, bool& doubtful) const;
  [[nodiscard]] Eigen::Vector3d shade(const Hit& hit, const Eigen::Vector3d& ray, double spread, bool& doubtful) const;
  [[nodiscard]] double level(const Hit& hit, const Eigen::Vector3d& ray, double spread) const;
  [[nodiscard]] double light(const Hit& hit, const Eigen::Vector3d& ray, bool& doubtful) const;
  [[nodiscard]] bool sees_sun(const Eigen::Vector3d& point, const Eigen::Vector3d& direction, bool& doubtful) const;
  [[nodiscard]] Eigen::Vector4d sample(std::int32_t texture, int level, const Eigen::Vector2d& uv,
                                       const scene::Sampling& sampling) const;
  [[nodiscard]] bool is_between_texels(std::int32_t texture, const Eigen::Vector2d& uv) const;

  const scene::Scene& scene_;
  std::vector<std::vector<render::MipLevel>> mips_;  // by texture
  std::vector<Eigen::AlignedBox3d> bounds_;          // by instance, in the world
};

}  // namespace wiw::testing
