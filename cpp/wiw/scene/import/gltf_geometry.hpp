// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <Eigen/Core>
#include <filesystem>
#include <string>
#include <vector>

#include "wiw/scene/import/gltf_data.hpp"
#include "wiw/scene/scene.hpp"

namespace wiw::scene {

/// How the vertices of a mesh are moved: by weights of its morph targets, and by the joints of a skin.
struct GltfPose {
  std::vector<float> weights;
  const std::vector<Eigen::Matrix4f>* joints = nullptr;
};

/// A primitive of a glTF mesh in the file's own axes; triangles without area are dropped. `mesh` names it in messages.
/// What cannot be drawn of it is added to the warnings. Throws FileError for damage.
Mesh convert_gltf_primitive(const Json& document, const Json& primitive, const GltfPose& pose, GltfData& data,
                            const std::filesystem::path& path, const std::string& mesh,
                            std::vector<std::string>& warnings);

}  // namespace wiw::scene
