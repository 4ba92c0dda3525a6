// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <Eigen/Core>
#include <cstdint>
#include <filesystem>
#include <string>
#include <vector>

#include "wiw/scene/import/limits.hpp"
#include "wiw/scene/triangle.hpp"

namespace wiw::scene {

/// The mesh of a PLY file, in its own axes, with a number for each face, such as the object that the face belongs to.
struct PlySurface {
  std::vector<Eigen::Vector3f> vertices;
  std::vector<Eigen::Matrix<std::uint8_t, 4, 1>> colors;  // empty, or one per vertex
  std::vector<Triangle> triangles;                        // faces of more corners are cut
  std::vector<std::int64_t> labels;                       // of each triangle
};

/// Reads a binary PLY file whose faces have the integer property `label`. assimp reads no properties of faces.
/// Throws FileError for a missing, damaged or too large file, and for one without that property.
PlySurface read_ply_surface(const std::filesystem::path& path, const std::string& label,
                            const ImportLimits& limits = {});

}  // namespace wiw::scene
