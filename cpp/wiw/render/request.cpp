// SPDX-License-Identifier: Apache-2.0
#include "wiw/render/request.hpp"

#include <string>

#include "wiw/core/error.hpp"

namespace wiw::render {

void check_request(std::span<const Pose> T_world_camera, const Camera& camera) {
  const Size size = camera.size;
  if (size.height < 1 || size.width < 1 || size.height > kMaxImageSide || size.width > kMaxImageSide) {
    throw ArgumentError("render: expected an image size from 1 to " + std::to_string(kMaxImageSide) + ", got " +
                        std::to_string(size.height) + " x " + std::to_string(size.width));
  }
  if (camera.projection == Projection::kPerspective && !(camera.hfov > 0.0 && camera.hfov < kPi)) {
    throw ArgumentError("render: expected a horizontal field of view in (0, 180) degrees, got " +
                        std::to_string(degrees(camera.hfov)));
  }
  for (std::size_t i = 0; i < T_world_camera.size(); ++i) {
    const Eigen::Matrix3d rotation = T_world_camera[i].linear();
    if (!T_world_camera[i].matrix().allFinite() || !(rotation * rotation.transpose()).isIdentity(1e-4) ||
        rotation.determinant() < 0) {
      throw ArgumentError("render: T_world_camera[" + std::to_string(i) + "] is not a finite rigid transform");
    }
    if (T_world_camera[i].translation().cwiseAbs().maxCoeff() > kFarthestCamera) {
      throw ArgumentError("render: T_world_camera[" + std::to_string(i) + "] lies beyond 1e9 m from the origin");
    }
  }
}

void check_options(const RenderOptions& options) {
  if (options.samples != 1 && options.samples != 4 && options.samples != 9 && options.samples != 16) {
    throw ArgumentError("render: expected 1, 4, 9 or 16 samples a pixel, got " + std::to_string(options.samples));
  }
}

void check_poses(const scene::Scene& scene, std::span<const std::uint32_t> ids,
                 std::span<const Eigen::Affine3f> poses) {
  if (ids.size() != poses.size()) {
    throw ArgumentError("set_poses: expected as many poses as ids, got " + std::to_string(ids.size()) + " ids and " +
                        std::to_string(poses.size()) + " poses");
  }
  for (std::size_t i = 0; i < ids.size(); ++i) {
    if (ids[i] < 1 || ids[i] > scene.instances.size()) {
      throw ArgumentError("set_poses: instance " + std::to_string(ids[i]) + " does not exist; ids run from 1 to " +
                          std::to_string(scene.instances.size()));
    }
    if (!poses[i].matrix().allFinite()) {
      throw ArgumentError("set_poses: the pose of instance " + std::to_string(ids[i]) + " is not finite");
    }
  }
}

}  // namespace wiw::render
