// SPDX-License-Identifier: Apache-2.0
#include "wiw/render/gpu/view.hpp"

#include <algorithm>
#include <cmath>

#include "wiw/render/shading.hpp"

namespace wiw::render::gpu {

namespace {

ViewBlock oriented_view(const Pose& pose, const Eigen::Matrix3f& axes) {
  const Eigen::Matrix3f rotation = pose.linear().cast<float>() * axes;
  ViewBlock view;
  view.right.head<3>() = rotation.col(0);
  view.up.head<3>() = rotation.col(1);
  view.back.head<3>() = rotation.col(2);
  view.eye.head<3>() = pose.translation().cast<float>();
  view.panorama_up.head<3>() = pose.linear().col(1).cast<float>();
  return view;
}

/// S rays a pixel narrow each ray's footprint by sqrt(S).
float lod_bias(int samples) { return -0.5f * std::log2(static_cast<float>(samples)); }

Eigen::Matrix3f axes(const Eigen::Vector3f& right, const Eigen::Vector3f& up) {
  Eigen::Matrix3f matrix;
  matrix << right, up, right.cross(up);
  return matrix;
}

}  // namespace

ViewBlock perspective_view(const Pose& T_world_camera, const Camera& camera, const Eigen::Vector2f& sample,
                           int samples) {
  ViewBlock view = oriented_view(T_world_camera, Eigen::Matrix3f::Identity());
  const auto width = static_cast<float>(camera.size.width);
  const auto height = static_cast<float>(camera.size.height);
  const auto focal = static_cast<float>(Intrinsics{camera.size, camera.hfov}.focal());
  // Image rows run downwards and are written in that order, so that read-back needs no flip.
  view.projection = {2 * focal / width, -2 * focal / height, 2 * sample.x() / width, 2 * sample.y() / height};
  view.lens = {shading::kNearClip, 1 / focal, 0, lod_bias(samples)};
  return view;
}

const std::array<Eigen::Matrix3f, kFaces>& face_axes() {
  using V = Eigen::Vector3f;
  static const std::array<Eigen::Matrix3f, kFaces> kAxes{axes(V::UnitX(), V::UnitY()),  axes(V::UnitZ(), V::UnitY()),
                                                         axes(-V::UnitX(), V::UnitY()), axes(-V::UnitZ(), V::UnitY()),
                                                         axes(V::UnitX(), V::UnitZ()),  axes(V::UnitX(), -V::UnitZ())};
  return kAxes;
}

ViewBlock face_view(const Pose& T_world_camera, int face, Size panorama, int samples) {
  ViewBlock view = oriented_view(T_world_camera, face_axes()[static_cast<std::size_t>(face)]);
  view.projection = {1, -1, 0, 0};
  view.lens = {shading::kNearClip / std::sqrt(3.f), static_cast<float>(kPi / panorama.height),
               static_cast<float>(2 * kPi / panorama.width), lod_bias(samples)};
  return view;
}

int face_size(Size panorama, int samples) {
  const double pixel = std::min(kPi / panorama.height, 2 * kPi / panorama.width) / std::sqrt(samples);
  return static_cast<int>(std::ceil(2 / pixel * kFaceOversampling));
}

}  // namespace wiw::render::gpu
