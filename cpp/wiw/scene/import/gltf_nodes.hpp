// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <Eigen/Core>
#include <string>

#include "wiw/scene/import/json.hpp"
#include "wiw/scene/import/limits.hpp"

namespace wiw::scene {

/// Checks what a glTF document's scene grows to before anything is copied: a node with several parents is copied for
/// each of them, and so are vertices that several meshes share. Throws FileError for nodes among their own descendants,
/// nested too deep or more than the limit, and for more vertices than the limit of triangles can have.
void check_gltf_size(const Json& document, const ImportLimits& limits, const std::string& path);

/// Of a translation, a rotation (a quaternion xyzw, of any length) and a scale; null pointers stand for none.
Eigen::Matrix4f compose_transform(const float* translation, const float* rotation, const float* scale);

/// A node's own transform, from its matrix or from translation, rotation and scale.
Eigen::Matrix4f local_transform(const Json& node);

/// Most vertices and corners together that a file within the limit of triangles has use for.
std::size_t vertex_limit(const ImportLimits& limits);

/// Indices of the nodes at the top of the scene that is drawn.
const Json& scene_roots(const Json& document);

}  // namespace wiw::scene
