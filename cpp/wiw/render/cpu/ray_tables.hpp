// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <vector>

#include "wiw/render/cpu/kernel.hpp"
#include "wiw/render/renderer.hpp"

namespace wiw::render::cpu {

/// Per-row and per-column factors of a camera's rays, for the pixel centres and for every colour sample.
class RayTables {
 public:
  RayTables(const Camera& camera, int samples);

  /// The grids point into this object.
  [[nodiscard]] KernelView view(const Pose& T_world_camera) const;
  [[nodiscard]] bool fits(const Camera& camera) const;

 private:
  RayGrid add_grid(double dx, double dy);

  Camera camera_;
  int samples_;
  std::vector<std::vector<float>> tables_;
  RayGrid center_{};
  std::vector<RayGrid> grids_;
};

}  // namespace wiw::render::cpu
