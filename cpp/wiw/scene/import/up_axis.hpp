// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <Eigen/Core>
#include <filesystem>
#include <string>

#include "wiw/scene/import.hpp"
#include "wiw/scene/import/mesh_format.hpp"

namespace wiw::scene {

struct UpAxis {
  char axis = 'Y';     // 'X', 'Y' or 'Z'
  std::string reason;  // "by file header"
  /// Rotates the file's axes to Y up: Z up is (x, y, z) -> (x, z, -y).
  [[nodiscard]] Eigen::Matrix3f to_y_up() const;
  /// "Z (by file header)", the text of Scene::attributes["up"].
  [[nodiscard]] std::string text() const { return std::string(1, axis) + " (" + reason + ")"; }
};

/// The explicit rule, first match wins:
///  1. `up` is kY or kZ: as asked;
///  2. DAE with <up_axis>: by file header; without: Y, the COLLADA default;
///  3. names ending in `.basis.glb` or `.semantic.glb`: Z, because HM3D ships its meshes that way against the glTF
///  rule;
///  4. GLB and glTF: Y, by the specification;
///  5. OBJ and PLY, which do not say: Y.
UpAxis up_axis_of(const std::filesystem::path& path, MeshFormat format, Up up);

}  // namespace wiw::scene
