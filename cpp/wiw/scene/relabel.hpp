// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <Eigen/Core>
#include <cstdint>
#include <span>

#include "wiw/scene/labels.hpp"
#include "wiw/scene/scene.hpp"

namespace wiw::scene {

/// A part of a triangle's surface that belongs to one instance.
struct LabelledPiece {
  std::uint32_t triangle = 0;  // in the order of `world_triangles`
  std::uint32_t instance = 0;  // Instance::id, from 1
  /// Row i: barycentric coordinates of the piece's corner i in the triangle; the identity is the whole triangle.
  Eigen::Matrix3f corners = Eigen::Matrix3f::Identity();
};

/// The same surface with other instances: each piece goes to the instance that it names, all in world coordinates.
/// Instances without pieces have no mesh, so that ids are those of a list that the scene does not show in whole. What
/// no piece covers is left out. Throws ArgumentError for a piece of no triangle or no instance, and for a scene with
/// lightmaps.
ScenePtr relabel(const Scene& scene, std::span<const LabelledPiece> pieces, SceneLabels labels);

}  // namespace wiw::scene
