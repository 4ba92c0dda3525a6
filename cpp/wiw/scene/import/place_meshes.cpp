// SPDX-License-Identifier: Apache-2.0
#include "wiw/scene/import/place_meshes.hpp"

#include <Eigen/Eigenvalues>
#include <algorithm>

#include "wiw/scene/import/category.hpp"
#include "wiw/scene/import/mesh_baker.hpp"

namespace wiw::scene {
namespace {

/// False for a stretch to a line or a point; what it flattens to a plane can still be seen.
bool spans_a_plane(const Eigen::Matrix3f& stretch) {
  const Eigen::SelfAdjointEigenSolver<Eigen::Matrix3d> solver(stretch.cast<double>(), Eigen::EigenvaluesOnly);
  Eigen::Array3d lengths = solver.eigenvalues().array().abs();
  std::ranges::sort(lengths);
  return lengths[1] > 1e-9;
}

}  // namespace

void place_meshes(const std::vector<PlacedMeshes>& placed, const std::filesystem::path& path,
                  const ImportLimits& limits, const UpAxis& up, Scene& scene) {
  MeshBaker baker(scene);
  const Eigen::Matrix3f turn = up.to_y_up();
  std::size_t triangles = 0;
  for (const PlacedMeshes& node : placed) {
    // turn (R S p + t) = (turn R turn^T) (turn S p) + turn t: the first factor stays in the pose, the second is baked.
    const auto [rotation, stretch] = split_rotation(node.T_file_node.linear());
    if (!spans_a_plane(stretch)) {
      scene.warnings.push_back("node '" + node.name + "' is scaled to nothing and left out");
      continue;
    }
    Instance instance;
    instance.id = static_cast<std::uint32_t>(scene.instances.size() + 1);
    instance.name = node.name;
    instance.category = category_index(scene, node.category);
    instance.T_world_instance.linear() = turn * rotation * turn.transpose();
    instance.T_world_instance.translation() = turn * node.T_file_node.translation();
    for (const Mesh* mesh : node.meshes) {
      if (mesh->triangles.empty()) continue;
      triangles += mesh->triangles.size();
      check_limit(path.string(), "triangles", triangles, limits.triangles, "triangles");
      instance.meshes.push_back(baker.bake(*mesh, Eigen::Affine3f(turn * stretch), mesh->material));
    }
    if (!instance.meshes.empty()) scene.instances.push_back(std::move(instance));
  }
}

}  // namespace wiw::scene
