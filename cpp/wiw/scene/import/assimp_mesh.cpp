// SPDX-License-Identifier: Apache-2.0
#include <assimp/scene.h>

#include <algorithm>
#include <cmath>

#include "wiw/core/error.hpp"
#include "wiw/scene/import/assimp_scene.hpp"
#include "wiw/scene/import/polygon.hpp"
#include "wiw/scene/import/weld.hpp"

namespace wiw::scene {
namespace {

using Rgba8 = Eigen::Matrix<std::uint8_t, 4, 1>;

Eigen::Vector3f vec(const aiVector3D& v) { return {v.x, v.y, v.z}; }

std::string label(const aiMesh& mesh, unsigned index) {
  return mesh.mName.length > 0 ? "mesh '" + std::string(mesh.mName.C_Str()) + "'" : "mesh " + std::to_string(index);
}

std::vector<Eigen::Vector3f> positions_of(const aiMesh& source, const std::string& path, const std::string& name) {
  std::vector<Eigen::Vector3f> positions;
  positions.reserve(source.mNumVertices);
  for (unsigned i = 0; i < source.mNumVertices; ++i) {
    positions.push_back(vec(source.mVertices[i]));
    if (!positions.back().allFinite()) {
      throw FileError(path, name + ": vertex " + std::to_string(i) + " is not finite (damaged file)");
    }
  }
  return positions;
}

std::vector<Triangle> triangles_of(const aiMesh& source, const std::vector<Eigen::Vector3f>& positions) {
  std::vector<Triangle> triangles;
  triangles.reserve(source.mNumFaces);
  for (unsigned i = 0; i < source.mNumFaces; ++i) {
    triangulate({source.mFaces[i].mIndices, source.mFaces[i].mNumIndices}, positions, triangles);
  }
  return triangles;
}

/// Empty unless every normal is usable: the renderer's geometric normal is better than a guess.
std::vector<Eigen::Vector3f> normals_of(const aiMesh& source) {
  std::vector<Eigen::Vector3f> normals;
  if (!source.HasNormals()) return normals;
  normals.reserve(source.mNumVertices);
  for (unsigned i = 0; i < source.mNumVertices; ++i) {
    const Eigen::Vector3f normal = vec(source.mNormals[i]);
    const float length = normal.norm();
    if (!std::isfinite(length) || length < 1e-6f) return {};
    normals.emplace_back(normal / length);
  }
  return normals;
}

/// assimp counts v from the bottom edge, the scene from the top.
std::vector<Eigen::Vector2f> uv_of(const aiMesh& source, const aiMaterial& material, const std::string& path,
                                   const std::string& name) {
  int channel = 0;
  material.Get(AI_MATKEY_UVWSRC_DIFFUSE(0), channel);
  if (channel < 0 || channel >= AI_MAX_NUMBER_OF_TEXTURECOORDS) channel = 0;
  std::vector<Eigen::Vector2f> uv;
  if (!source.HasTextureCoords(static_cast<unsigned>(channel))) return uv;
  uv.reserve(source.mNumVertices);
  for (unsigned i = 0; i < source.mNumVertices; ++i) {
    const aiVector3D& coordinate = source.mTextureCoords[channel][i];
    uv.emplace_back(coordinate.x, 1.f - coordinate.y);
    if (!uv.back().allFinite()) {
      throw FileError(path, name + ": texture coordinate " + std::to_string(i) + " is not finite (damaged file)");
    }
  }
  return uv;
}

std::uint8_t quantised(float value, bool linear) {
  const float clamped = value > 0.f ? std::min(value, 1.f) : 0.f;  // NaN becomes 0
  return static_cast<std::uint8_t>(std::lround(255.f * (linear ? std::pow(clamped, 1.f / 2.2f) : clamped)));
}

/// glTF vertex colours are linear light, those of the other formats display-encoded.
std::vector<Rgba8> colors_of(const aiMesh& source, bool linear) {
  std::vector<Rgba8> colors;
  if (!source.HasVertexColors(0)) return colors;
  colors.reserve(source.mNumVertices);
  for (unsigned i = 0; i < source.mNumVertices; ++i) {
    const aiColor4D& c = source.mColors[0][i];
    colors.emplace_back(quantised(c.r, linear), quantised(c.g, linear), quantised(c.b, linear), quantised(c.a, false));
  }
  return colors;
}

}  // namespace

Mesh convert_mesh(const aiScene& file, unsigned index, const FileContext& context, Scene& scene) {
  const aiMesh& source = *file.mMeshes[index];
  const std::string path = context.path.string();
  const std::string name = label(source, index);
  Mesh mesh;
  auto positions = positions_of(source, path, name);
  mesh.triangles = triangles_of(source, positions);
  mesh.positions = std::move(positions);
  mesh.normals = normals_of(source);
  if (source.HasNormals() && mesh.normals.empty()) {
    scene.warnings.push_back(name + " of " + context.path.filename().string() +
                             " has normals of no length; its geometric normals are used");
  }
  mesh.uv = uv_of(source, *file.mMaterials[source.mMaterialIndex], path, name);
  const bool linear = context.format == MeshFormat::kGlb || context.format == MeshFormat::kGltf;
  mesh.colors = colors_of(source, linear);
  mesh.material = static_cast<std::int32_t>(source.mMaterialIndex);
  return weld(mesh);
}

}  // namespace wiw::scene
