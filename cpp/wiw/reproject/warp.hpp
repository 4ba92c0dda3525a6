// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <span>

#include "wiw/core/cpu.hpp"
#include "wiw/core/pose.hpp"
#include "wiw/reproject/mesh.hpp"

namespace wiw::reproject {

/// Where results go; null members are left out. Batch-major, dense.
struct WarpTargets {
  std::uint8_t* color = nullptr;  // [B, T, h, w, 3]
  float* depth = nullptr;         // [B, T, h, w] metres, 0 where nothing is hit
  std::uint8_t* hole =
      nullptr;  // [B, T, h, w] 1 where the source did not see what is there, or saw its other side: guesses
};

/// Shows RGB-D images from other poses: the depth mesh of each source is drawn into the target's depth, and every
/// target pixel looks its colour up in the source once, so that nothing is blurred twice; see fill_holes for the rest.
/// Results depend neither on threads nor on the instruction set.
class Warp {
 public:
  /// `cut`: see build_mesh.
  Warp(const View& source, const View& target, float cut = 0.1F);

  /// `color` [B, H, W, 3], `depth` [B, H, W]; `T_source_target` [B, T] maps the target camera's coordinates to the
  /// source camera's, that is: it is the pose of the imagined camera in the frame of the real one.
  void operator()(const std::uint8_t* color, const float* depth, std::size_t sources,
                  std::span<const Pose> T_source_target, const WarpTargets& out, Isa isa = active_isa()) const;

  [[nodiscard]] const View& source() const { return layout_.view; }
  [[nodiscard]] const View& target() const { return target_; }

 private:
  void warp_one(const std::uint8_t* color, const float* depth, const DepthMesh& mesh, const Pose& T_source_target,
                std::size_t frame, const WarpTargets& out, Isa isa) const;

  MeshLayout layout_;
  View target_;
  RayTable target_rays_;
  float cut_;
};

}  // namespace wiw::reproject
