// SPDX-License-Identifier: Apache-2.0
#include "wiw/physics/mesh_file.hpp"

#include <assimp/config.h>
#include <assimp/postprocess.h>
#include <assimp/scene.h>

#include <assimp/Importer.hpp>

#include "wiw/core/error.hpp"
#include "wiw/physics/shape.hpp"

namespace wiw::physics {

namespace fs = std::filesystem;

namespace {

constexpr std::uintmax_t kMaxBytes = 256u << 20;  // collision meshes are kilobytes

std::vector<Eigen::Vector3d> vertices_of(const aiScene& scene, const Eigen::Vector3d& scale) {
  std::vector<Eigen::Vector3d> points;
  for (unsigned m = 0; m < scene.mNumMeshes; ++m) {
    const aiMesh& mesh = *scene.mMeshes[m];
    for (unsigned v = 0; v < mesh.mNumVertices; ++v) {
      const aiVector3D& p = mesh.mVertices[v];
      points.emplace_back(scale.x() * p.x, scale.y() * p.y, scale.z() * p.z);
    }
  }
  return points;
}

}  // namespace

std::vector<Eigen::Vector3d> hull_of_file(const fs::path& path, const Eigen::Vector3d& scale, const std::string& link) {
  const auto fail = [&](const std::string& cause) {
    return FileError(path.string(), cause + " (mesh of link '" + link + "')");
  };
  std::error_code error;
  const std::uintmax_t bytes = fs::file_size(path, error);
  if (error) throw fail("no such file");
  if (bytes > kMaxBytes) throw fail("larger than 256 MiB, which a collision mesh has no need of");
  Assimp::Importer importer;
  importer.SetPropertyBool(AI_CONFIG_IMPORT_COLLADA_IGNORE_UP_DIRECTION, true);  // URDF knows the file's axes only
  const aiScene* scene =
      importer.ReadFile(path.string(), aiProcess_PreTransformVertices | aiProcess_JoinIdenticalVertices);
  if (scene == nullptr) throw fail(importer.GetErrorString());
  const std::vector<Eigen::Vector3d> points = vertices_of(*scene, scale);
  for (const Eigen::Vector3d& point : points) {
    if (!point.allFinite()) throw fail("a vertex is not finite");
  }
  const HullMesh hull = hull_mesh(points);
  if (hull.vertices.empty()) throw fail("its vertices span no volume");
  return hull.vertices;
}

fs::path find_mesh(const std::string& name, const fs::path& folder) {
  const std::string package = "package://", file = "file://";
  if (name.starts_with(file)) return name.substr(file.size());
  if (!name.starts_with(package)) return folder / name;
  const fs::path inside = name.substr(package.size());
  const fs::path rest = inside.lexically_relative(*inside.begin());
  for (fs::path at = fs::absolute(folder);; at = at.parent_path()) {
    if (fs::exists(at / inside)) return at / inside;
    if (at.filename() == *inside.begin() && fs::exists(at / rest)) return at / rest;
    if (at == at.parent_path()) break;
  }
  return folder / inside;
}

}  // namespace wiw::physics
