// SPDX-License-Identifier: Apache-2.0
#include "wiw/scene/import.hpp"

#include <assimp/config.h>
#include <assimp/postprocess.h>
#include <assimp/scene.h>

#include <assimp/Importer.hpp>

#include "wiw/core/error.hpp"
#include "wiw/scene/import/assimp_scene.hpp"
#include "wiw/scene/import/ceiling.hpp"
#include "wiw/scene/import/file.hpp"
#include "wiw/scene/import/gltf_json.hpp"

namespace wiw {
namespace {

constexpr unsigned kSteps =
    aiProcess_Triangulate | aiProcess_JoinIdenticalVertices | aiProcess_SortByPType | aiProcess_TransformUVCoords;

const aiScene& parse(Assimp::Importer& importer, const std::filesystem::path& path, const ImportOptions& options) {
  // The file's axes are turned by UpAxis alone, so that one rule holds for every format.
  importer.SetPropertyBool(AI_CONFIG_IMPORT_COLLADA_IGNORE_UP_DIRECTION, true);
  importer.SetPropertyBool(AI_CONFIG_IMPORT_COLLADA_USE_COLLADA_NAMES, true);
  importer.SetPropertyInteger(AI_CONFIG_PP_SBP_REMOVE, aiPrimitiveType_POINT | aiPrimitiveType_LINE);
  const aiScene* file =
      importer.ReadFile(path.string(), kSteps | (options.smooth_normals ? aiProcess_GenSmoothNormals : 0U));
  if (!file) throw FileError(path.string(), "cannot be read: " + std::string(importer.GetErrorString()));
  if ((file->mFlags & AI_SCENE_FLAGS_INCOMPLETE) || !file->mRootNode) {
    throw FileError(path.string(), "holds no complete scene");
  }
  return *file;
}

void warn_of_basis_textures(const FileContext& context, Scene& scene) {
  if (context.format != MeshFormat::kGlb && context.format != MeshFormat::kGltf) return;
  const std::size_t count = count_basis_textures(context.path, context.format);
  if (count == 0) return;
  scene.warnings.push_back(std::to_string(count) + " textures of " + context.path.filename().string() +
                           " are stored in Basis Universal, which cannot be decoded here; drawn without texture "
                           "(convert them to PNG or JPEG, or use the uncompressed mesh)");
}

}  // namespace

ScenePtr load_mesh(const std::filesystem::path& path, const ImportOptions& options) {
  const MeshFormat format = mesh_format_of(path);
  check_limit(path.string(), "bytes", size_of_file(path), options.limits.file_bytes, "file_bytes");
  check_signature(path, format);
  const FileContext context{path, format, options};
  auto scene = std::make_shared<Scene>();
  warn_of_basis_textures(context, *scene);
  if (options.trace) options.trace->read.push_back(path);

  const auto importer = make_importer();
  const aiScene& file = parse(*importer, path, options);
  const UpAxis up = up_axis_of(path, format, options.up);
  scene->name = path.stem().string();
  scene->attributes["up"] = up.text();
  convert_materials(file, context, *scene);
  convert_nodes(file, context, up, *scene);
  if (scene->instances.empty()) throw FileError(path.string(), "holds no triangles");
  if (options.ceiling_height) add_ceiling(*scene, *options.ceiling_height);
  scene->validate();
  return scene;
}

}  // namespace wiw
