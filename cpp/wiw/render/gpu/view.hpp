// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <Eigen/Geometry>
#include <array>

#include "wiw/render/renderer.hpp"

namespace wiw::render::gpu {

/// One rasterised view, laid out as the shaders' uniform block `View` (std140).
struct ViewBlock {
  Eigen::Vector4f right = Eigen::Vector4f::Zero();
  Eigen::Vector4f up = Eigen::Vector4f::Zero();
  Eigen::Vector4f back = Eigen::Vector4f::Zero();
  Eigen::Vector4f eye = Eigen::Vector4f::Zero();
  Eigen::Vector4f projection = Eigen::Vector4f::Zero();
  Eigen::Vector4f lens = Eigen::Vector4f::Zero();
  Eigen::Vector4f panorama_up = Eigen::Vector4f::Zero();
};
static_assert(sizeof(ViewBlock) == 7 * 16);

/// `sample` is the offset of the ray from the pixel centre in pixels (right, down); `samples` the rays a pixel has.
ViewBlock perspective_view(const Pose& T_world_camera, const Camera& camera, const Eigen::Vector2f& sample,
                           int samples);

/// The six faces of a panorama: front, right, back, left, top, bottom; each spans 90 degrees.
constexpr int kFaces = 6;

/// Columns are the axes right, up, back of a face in camera coordinates.
const std::array<Eigen::Matrix3f, kFaces>& face_axes();

ViewBlock face_view(const Pose& T_world_camera, int face, Size panorama, int samples);

/// Texels along one side of a face so that one is at most `1 / kFaceOversampling` of a panorama pixel wide at the
/// face's centre, where it is widest.
constexpr double kFaceOversampling = 2.0;
int face_size(Size panorama, int samples);

}  // namespace wiw::render::gpu
