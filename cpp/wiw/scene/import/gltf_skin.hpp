// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <Eigen/Core>
#include <cstddef>
#include <filesystem>
#include <functional>
#include <vector>

#include "wiw/scene/import/gltf_data.hpp"
#include "wiw/scene/import/json.hpp"

namespace wiw::scene {

/// Joints and weights of vertices, in sets of four.
struct SkinWeights {
  std::vector<GltfValues> joints, weights;
};

/// Of each joint of a skin, the map from the mesh at bind to the scene at rest. `read` gives an accessor's values.
std::vector<Eigen::Matrix4f> joint_matrices(const Json& document, std::size_t skin,
                                            const std::function<GltfValues(std::size_t)>& read,
                                            const std::filesystem::path& path);

/// The weighted mean of the maps of each vertex's joints. Throws FileError for a joint that is not there.
std::vector<Eigen::Matrix4f> vertex_maps(const SkinWeights& skin, const std::vector<Eigen::Matrix4f>& joints,
                                         const std::filesystem::path& path);

/// Positions, or normals, each by its own map.
void move_vertices(const std::vector<Eigen::Matrix4f>& maps, bool are_normals, GltfValues& values);

}  // namespace wiw::scene
