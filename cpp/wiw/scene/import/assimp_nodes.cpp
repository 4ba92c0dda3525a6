// SPDX-License-Identifier: Apache-2.0
#include <assimp/scene.h>

#include <Eigen/Eigenvalues>
#include <algorithm>

#include "wiw/core/error.hpp"
#include "wiw/scene/import/assimp_scene.hpp"
#include "wiw/scene/import/category.hpp"
#include "wiw/scene/import/mesh_baker.hpp"

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

/// False for a stretch to a line or a point; what it flattens to a plane can still be seen.
bool spans_a_plane(const Eigen::Matrix3f& stretch) {
  const Eigen::SelfAdjointEigenSolver<Eigen::Matrix3d> solver(stretch.cast<double>(), Eigen::EigenvaluesOnly);
  Eigen::Array3d lengths = solver.eigenvalues().array().abs();
  std::ranges::sort(lengths);
  return lengths[1] > 1e-9;
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
  std::size_t triangles = 0;
  std::vector<Mesh> sources(file.mNumMeshes);
  for (unsigned i = 0; i < file.mNumMeshes; ++i) sources[i] = convert_mesh(file, i, context, scene);

  MeshBaker baker(scene);
  const Eigen::Matrix3f turn = up.to_y_up();
  for (const auto& [node, T_file_node] : nodes) {
    // turn (R S p + t) = (turn R turn^T) (turn S p) + turn t: the first factor stays in the pose, the second is baked.
    const auto [rotation, stretch] = split_rotation(T_file_node.linear());
    if (!spans_a_plane(stretch)) {
      scene.warnings.push_back("node '" + std::string(node->mName.C_Str()) + "' is scaled to nothing and left out");
      continue;
    }
    Instance instance;
    instance.id = static_cast<std::uint32_t>(scene.instances.size() + 1);
    instance.name = node->mName.C_Str();
    instance.category = category_index(scene, category_of(file, *node));
    instance.T_world_instance.linear() = turn * rotation * turn.transpose();
    instance.T_world_instance.translation() = turn * T_file_node.translation();
    for (unsigned i = 0; i < node->mNumMeshes; ++i) {
      const Mesh& source = sources.at(node->mMeshes[i]);
      if (source.triangles.empty()) continue;
      triangles += source.triangles.size();
      check_limit(context.path.string(), "triangles", triangles, context.options.limits.triangles, "triangles");
      instance.meshes.push_back(baker.bake(source, Eigen::Affine3f(turn * stretch), source.material));
    }
    if (!instance.meshes.empty()) scene.instances.push_back(std::move(instance));
  }
}

}  // namespace wiw::scene
