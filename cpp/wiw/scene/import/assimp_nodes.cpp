// SPDX-License-Identifier: Apache-2.0
#include <assimp/scene.h>

#include "wiw/core/error.hpp"
#include "wiw/scene/import/assimp_scene.hpp"
#include "wiw/scene/import/category.hpp"
#include "wiw/scene/import/place_meshes.hpp"

namespace wiw::scene {
namespace {

Eigen::Affine3f affine(const aiMatrix4x4& m) {
  Eigen::Affine3f map;
  map.matrix() << m.a1, m.a2, m.a3, m.a4, m.b1, m.b2, m.b3, m.b4, m.c1, m.c2, m.c3, m.c4, 0, 0, 0, 1;
  return map;
}

struct PlacedNode {
  const aiNode* node;
  Eigen::Affine3f T_file_node;
};

/// Depth first in file order, without recursion: the depth of the graph is the file's choice.
std::vector<PlacedNode> placed_nodes(const aiScene& file, const FileContext& context) {
  std::vector<PlacedNode> placed;
  std::vector<PlacedNode> stack{{file.mRootNode, affine(file.mRootNode->mTransformation)}};
  std::size_t count = 0;
  while (!stack.empty()) {
    const PlacedNode current = stack.back();
    stack.pop_back();
    check_limit(context.path.string(), "nodes", ++count, context.options.limits.nodes, "nodes");
    if (!current.T_file_node.matrix().allFinite()) {
      throw FileError(context.path.string(), "the transform of node '" + std::string(current.node->mName.C_Str()) +
                                                 "' is not finite (damaged file)");
    }
    if (current.node->mNumMeshes > 0) placed.push_back(current);
    for (unsigned i = current.node->mNumChildren; i-- > 0;) {
      const aiNode* child = current.node->mChildren[i];
      stack.push_back({child, current.T_file_node * affine(child->mTransformation)});
    }
  }
  return placed;
}

/// The node's name says best what a thing is, then its mesh's, then its material's.
std::string category_of(const aiScene& file, const aiNode& node) {
  std::string category = category_from_name(node.mName.C_Str());
  for (unsigned i = 0; i < node.mNumMeshes && category.empty(); ++i) {
    const aiMesh& mesh = *file.mMeshes[node.mMeshes[i]];
    category = category_from_name(mesh.mName.C_Str());
    if (category.empty()) category = category_from_name(file.mMaterials[mesh.mMaterialIndex]->GetName().C_Str());
  }
  return category;
}

}  // namespace

void convert_nodes(const aiScene& file, const FileContext& context, const UpAxis& up, Scene& scene) {
  const std::vector<PlacedNode> nodes = placed_nodes(file, context);
  std::vector<Mesh> sources(file.mNumMeshes);
  for (unsigned i = 0; i < file.mNumMeshes; ++i) sources[i] = convert_mesh(file, i, context, scene);
  std::vector<PlacedMeshes> placed;
  for (const auto& [node, T_file_node] : nodes) {
    PlacedMeshes meshes{node->mName.C_Str(), category_of(file, *node), T_file_node, {}};
    for (unsigned i = 0; i < node->mNumMeshes; ++i) meshes.meshes.push_back(&sources.at(node->mMeshes[i]));
    placed.push_back(std::move(meshes));
  }
  place_meshes(placed, context.path, context.options.limits, up, scene);
}

}  // namespace wiw::scene
