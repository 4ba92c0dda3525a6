// SPDX-License-Identifier: Apache-2.0
#include "wiw/scene/relabel.hpp"

#include <algorithm>
#include <map>
#include <utility>

#include "wiw/core/error.hpp"
#include "wiw/scene/import/weld.hpp"

namespace wiw::scene {
namespace {

using Rgba8 = Eigen::Matrix<std::uint8_t, 4, 1>;

/// One mesh as it is placed, and the number of its first triangle in `world_triangles`.
struct PlacedMesh {
  const Mesh* mesh;
  Eigen::Affine3f T_world_instance;
  std::size_t first;
};

std::vector<PlacedMesh> placed_meshes(const Scene& scene) {
  std::vector<PlacedMesh> placed;
  std::size_t first = 0;
  for (const Instance& instance : scene.instances) {
    for (const std::uint32_t index : instance.meshes) {
      const Mesh& mesh = scene.meshes[index];
      if (mesh.lightmap != kNone) throw ArgumentError("relabel: a scene with lightmaps cannot be cut");
      placed.push_back({&mesh, instance.T_world_instance, first});
      first += mesh.triangles.size();
    }
  }
  return placed;
}

/// Vertex arrays that grow piece by piece.
struct MeshDraft {
  std::vector<Eigen::Vector3f> positions;
  std::vector<Eigen::Vector3f> normals;
  std::vector<Eigen::Vector2f> uv;
  std::vector<Rgba8> colors;

  void add(const PlacedMesh& source, const Triangle& triangle, const Eigen::Vector3f& weights) {
    const Mesh& mesh = *source.mesh;
    const auto mixed = [&](const auto& values) {
      return (weights[0] * values[triangle[0]] + weights[1] * values[triangle[1]] + weights[2] * values[triangle[2]])
          .eval();
    };
    positions.push_back(source.T_world_instance * mixed(mesh.positions));
    if (!mesh.normals.empty()) {
      normals.push_back((source.T_world_instance.linear() * mixed(mesh.normals)).normalized());
    }
    if (!mesh.uv.empty()) uv.push_back(mixed(mesh.uv));
    if (mesh.colors.empty()) return;
    Eigen::Vector4f color = Eigen::Vector4f::Constant(0.5f);  // rounds
    for (int i = 0; i < 3; ++i) color += weights[i] * mesh.colors[triangle[i]].cast<float>();
    colors.emplace_back(color.cwiseMax(0.f).cwiseMin(255.f).cast<std::uint8_t>());
  }

  Mesh finish(std::int32_t material) && {
    Mesh mesh;
    std::vector<Triangle> triangles(positions.size() / 3);
    for (std::uint32_t i = 0; i < triangles.size(); ++i) triangles[i] = {3 * i, 3 * i + 1, 3 * i + 2};
    mesh.positions = std::move(positions);
    mesh.normals = std::move(normals);
    mesh.uv = std::move(uv);
    mesh.colors = std::move(colors);
    mesh.triangles = std::move(triangles);
    mesh.material = material;
    return weld(mesh);
  }
};

/// By instance, then by placed mesh: vertex arrays of one draft come from one source, so all of them have the same
/// attributes.
using MeshDrafts = std::map<std::pair<std::uint32_t, std::size_t>, MeshDraft>;

MeshDrafts cut(const std::vector<PlacedMesh>& placed, std::span<const LabelledPiece> pieces, std::size_t instances) {
  const std::size_t count = placed.empty() ? 0 : placed.back().first + placed.back().mesh->triangles.size();
  MeshDrafts drafts;
  for (const LabelledPiece& piece : pieces) {
    if (piece.triangle >= count || piece.instance < 1 || piece.instance > instances) {
      throw ArgumentError("relabel: a piece names triangle " + std::to_string(piece.triangle) + " of " +
                          std::to_string(count) + " and instance " + std::to_string(piece.instance) + " of " +
                          std::to_string(instances));
    }
    const auto after = std::ranges::upper_bound(placed, std::size_t{piece.triangle}, {}, &PlacedMesh::first);
    const auto source = static_cast<std::size_t>(after - placed.begin()) - 1;
    const PlacedMesh& from = placed[source];
    const Triangle triangle = from.mesh->triangles[piece.triangle - from.first];
    MeshDraft& draft = drafts[{piece.instance, source}];
    for (int corner = 0; corner < 3; ++corner) draft.add(from, triangle, piece.corners.row(corner).transpose());
  }
  return drafts;
}

}  // namespace

ScenePtr relabel(const Scene& scene, std::span<const LabelledPiece> pieces, SceneLabels labels) {
  const std::vector<PlacedMesh> placed = placed_meshes(scene);
  MeshDrafts drafts = cut(placed, pieces, labels.instances.size());
  auto result = std::make_shared<Scene>(scene);
  result->meshes.clear();
  set_labels(std::move(labels), *result);
  for (auto& [key, draft] : drafts) {
    const auto& [instance, source] = key;
    result->instances[instance - 1].meshes.push_back(static_cast<std::uint32_t>(result->meshes.size()));
    result->meshes.push_back(std::move(draft).finish(placed[source].mesh->material));
  }
  result->validate();
  return result;
}

}  // namespace wiw::scene
