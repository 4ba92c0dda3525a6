// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <Eigen/Core>
#include <cstdint>
#include <filesystem>
#include <string>
#include <vector>

namespace wiw::physics {

/// A surface to look at: smooth normals, and a colour where the file gives it one.
struct VisualMesh {
  std::vector<Eigen::Vector3f> positions, normals;
  std::vector<Eigen::Vector4f> colors;  // RGBA; alpha 0: the file says nothing
  std::vector<Eigen::Matrix<std::uint32_t, 3, 1>> triangles;
};

/// What a mesh file shows, as `hull_of_file` reads it. Materials give their diffuse colour; textures are not read.
VisualMesh surface_of_file(const std::filesystem::path& path, const Eigen::Vector3d& scale, const std::string& link);

/// Vertices of the convex hull of a mesh file (STL, OBJ, DAE, glTF, ...) in the file's axes, node transforms applied.
/// Throws FileError, which names file and `link`, for a file that is missing, damaged or flat.
std::vector<Eigen::Vector3d> hull_of_file(const std::filesystem::path& path, const Eigen::Vector3d& scale,
                                          const std::string& link);

/// Where a URDF's mesh file lies: `package://NAME/REST` is searched upwards from the description's folder, as
/// NAME/REST and as REST inside a folder of that name; other names are relative to it.
std::filesystem::path find_mesh(const std::string& name, const std::filesystem::path& folder);

}  // namespace wiw::physics
