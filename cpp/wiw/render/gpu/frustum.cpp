// SPDX-License-Identifier: Apache-2.0
#include "wiw/render/gpu/frustum.hpp"

#include <cmath>

namespace wiw::render::gpu {

Frustum::Frustum(const ViewBlock& view) {
  const Eigen::Vector3f right = view.right.head<3>();
  const Eigen::Vector3f up = view.up.head<3>();
  const Eigen::Vector3f forward = -view.back.head<3>();
  const Eigen::Vector3f eye = view.eye.head<3>();
  // |x| * scale <= depth, let out by the shift of a sample from the pixel centre.
  const float x = std::abs(view.projection[0]);
  const float y = std::abs(view.projection[1]);
  const float wide = 1 + std::abs(view.projection[2]);
  const float high = 1 + std::abs(view.projection[3]);
  normals_ = {wide * forward + x * right, wide * forward - x * right, high * forward + y * up, high * forward - y * up,
              forward};
  for (std::size_t i = 0; i < normals_.size(); ++i) offsets_[i] = -normals_[i].dot(eye);
  offsets_[4] -= view.lens[0];
}

Frustum Frustum::in_instance(const Eigen::Affine3f& T_world_instance) const {
  Frustum local;
  for (std::size_t i = 0; i < normals_.size(); ++i) {
    local.normals_[i] = T_world_instance.linear().transpose() * normals_[i];
    local.offsets_[i] = offsets_[i] + normals_[i].dot(T_world_instance.translation());
  }
  return local;
}

bool Frustum::may_see(const Eigen::AlignedBox3f& box) const {
  const Eigen::Vector3f centre = box.center();
  const Eigen::Vector3f half = 0.5f * box.sizes();
  for (std::size_t i = 0; i < normals_.size(); ++i) {
    if (normals_[i].dot(centre) + normals_[i].cwiseAbs().dot(half) + offsets_[i] < 0) return false;
  }
  return true;
}

}  // namespace wiw::render::gpu
