// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <span>

#include "wiw/render/renderer.hpp"

namespace wiw::render {

/// Largest image side; beyond it, single-precision pixel coordinates and int32 offsets stop being safe.
constexpr int kMaxImageSide = 16384;

/// Farthest camera from the origin, metres: single precision tells places apart by 64 m there, and Embree ends the
/// process for rays that start beyond 1.8e18.
constexpr double kFarthestCamera = 1e9;

/// Throws ArgumentError unless the poses are rigid transforms within reach and the camera can be drawn.
void check_request(std::span<const Pose> T_world_camera, const Camera& camera);

/// Throws ArgumentError unless the number of colour samples is 1, 4, 9 or 16.
void check_options(const RenderOptions& options);

/// Throws ArgumentError for ids the scene does not have, a length mismatch, or poses that are not finite.
void check_poses(const scene::Scene& scene, std::span<const std::uint32_t> ids, std::span<const Eigen::Affine3f> poses);

}  // namespace wiw::render
