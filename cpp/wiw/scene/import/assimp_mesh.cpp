// SPDX-License-Identifier: Apache-2.0
#include <assimp/scene.h>

#include "wiw/scene/import/assimp_scene.hpp"
#include "wiw/scene/import/mesh_arrays.hpp"
#include "wiw/scene/import/polygon.hpp"
#include "wiw/scene/import/weld.hpp"

namespace wiw::scene {
namespace {

using Rgba8 = Eigen::Matrix<std::uint8_t, 4, 1>;

std::string label(const aiMesh& mesh, unsigned index) {
  return mesh.mName.length > 0 ? "mesh '" + std::string(mesh.mName.C_Str()) + "'" : "mesh " + std::to_string(index);
}

std::vector<Eigen::Vector3f> vectors_of(const aiVector3D* vectors, unsigned count) {
  std::vector<Eigen::Vector3f> result;
  if (vectors == nullptr) return result;
  result.reserve(count);
  for (unsigned i = 0; i < count; ++i) result.emplace_back(vectors[i].x, vectors[i].y, vectors[i].z);
  return result;
}

std::vector<Triangle> triangles_of(const aiMesh& source, const std::vector<Eigen::Vector3f>& positions) {
  std::vector<Triangle> triangles;
  triangles.reserve(source.mNumFaces);
  for (unsigned i = 0; i < source.mNumFaces; ++i) {
    triangulate({source.mFaces[i].mIndices, source.mFaces[i].mNumIndices}, positions, triangles);
  }
  return triangles;
}

/// assimp counts v from the bottom edge, the scene from the top.
std::vector<Eigen::Vector2f> uv_of(const aiMesh& source, const aiMaterial& material) {
  int channel = 0;
  material.Get(AI_MATKEY_UVWSRC_DIFFUSE(0), channel);
  if (channel < 0 || channel >= AI_MAX_NUMBER_OF_TEXTURECOORDS) channel = 0;
  std::vector<Eigen::Vector2f> uv;
  if (!source.HasTextureCoords(static_cast<unsigned>(channel))) return uv;
  uv.reserve(source.mNumVertices);
  for (unsigned i = 0; i < source.mNumVertices; ++i) {
    const aiVector3D& coordinate = source.mTextureCoords[channel][i];
    uv.emplace_back(coordinate.x, 1.f - coordinate.y);
  }
  return uv;
}

std::vector<Rgba8> colors_of(const aiMesh& source) {
  std::vector<Rgba8> colors;
  if (!source.HasVertexColors(0)) return colors;
  colors.reserve(source.mNumVertices);
  for (unsigned i = 0; i < source.mNumVertices; ++i) {
    const aiColor4D& c = source.mColors[0][i];
    colors.emplace_back(display_byte(c.r, false), display_byte(c.g, false), display_byte(c.b, false),
                        display_byte(c.a, false));
  }
  return colors;
}

}  // namespace

Mesh convert_mesh(const aiScene& file, unsigned index, const FileContext& context, Scene& scene) {
  const aiMesh& source = *file.mMeshes[index];
  const std::string name = label(source, index);
  Mesh mesh;
  auto positions = vectors_of(source.mVertices, source.mNumVertices);
  check_positions(positions, context.path, name);
  mesh.triangles = triangles_of(source, positions);
  mesh.positions = std::move(positions);
  auto normals = vectors_of(source.mNormals, source.mNumVertices);
  if (!normalize_normals(normals)) {
    scene.warnings.push_back(name + " of " + context.path.filename().string() +
                             " has normals of no length; its geometric normals are used");
  }
  mesh.normals = std::move(normals);
  auto uv = uv_of(source, *file.mMaterials[source.mMaterialIndex]);
  check_texture_coordinates(uv, context.path, name);
  mesh.uv = std::move(uv);
  mesh.colors = colors_of(source);
  mesh.material = static_cast<std::int32_t>(source.mMaterialIndex);
  return weld(mesh);
}

}  // namespace wiw::scene
