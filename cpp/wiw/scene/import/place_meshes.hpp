// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <Eigen/Geometry>
#include <filesystem>
#include <string>
#include <vector>

#include "wiw/scene/import.hpp"
#include "wiw/scene/import/up_axis.hpp"

namespace wiw::scene {

/// Meshes, in the file's own axes, that a node of the file shows.
struct PlacedMeshes {
  std::string name;
  std::string category;
  Eigen::Affine3f T_file_node = Eigen::Affine3f::Identity();
  std::vector<const Mesh*> meshes;
};

/// One instance for each of these, and the meshes with it, turned to Y up. What is scaled to nothing is left out with
/// a warning. Throws FileError above the limit of triangles.
void place_meshes(const std::vector<PlacedMeshes>& placed, const std::filesystem::path& path,
                  const ImportLimits& limits, const UpAxis& up, Scene& scene);

}  // namespace wiw::scene
