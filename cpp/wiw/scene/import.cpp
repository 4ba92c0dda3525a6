// SPDX-License-Identifier: Apache-2.0
#include "wiw/scene/import.hpp"

#include <assimp/config.h>
#include <assimp/postprocess.h>
#include <assimp/scene.h>
#include <assimp/version.h>

#include <assimp/Importer.hpp>

#include "wiw/core/error.hpp"
#include "wiw/scene/cache.hpp"
#include "wiw/scene/import/assimp_scene.hpp"
#include "wiw/scene/import/ceiling.hpp"
#include "wiw/scene/import/collada_check.hpp"
#include "wiw/scene/import/extent.hpp"
#include "wiw/scene/import/file.hpp"
#include "wiw/scene/import/gltf_scene.hpp"
#include "wiw/scene/import/guarded_io.hpp"
#include "wiw/scene/import/ply_header.hpp"
#include "wiw/scene/text.hpp"

namespace wiw::scene {
namespace {

constexpr int kImporterVersion = 8;  // raise it whenever the same file and options give another scene

/// What comes after indexes arrays by what the file says.
void check_indices(const aiScene& file, const std::filesystem::path& path) {
  for (unsigned m = 0; m < file.mNumMeshes; ++m) {
    const aiMesh& mesh = *file.mMeshes[m];
    const std::string name = "mesh " + std::to_string(m) + " ('" + mesh.mName.C_Str() + "')";
    if (mesh.mMaterialIndex >= file.mNumMaterials) {
      throw FileError(path.string(), name + " names a material that is not there (damaged file)");
    }
    for (unsigned f = 0; f < mesh.mNumFaces; ++f) {
      for (unsigned i = 0; i < mesh.mFaces[f].mNumIndices; ++i) {
        if (mesh.mFaces[f].mIndices[i] < mesh.mNumVertices) continue;
        throw FileError(path.string(), name + ": face " + std::to_string(f) + " names vertex " +
                                           std::to_string(mesh.mFaces[f].mIndices[i]) + " of " +
                                           std::to_string(mesh.mNumVertices) + " (damaged file)");
      }
    }
  }
}

const aiScene& parse(Assimp::Importer& importer, const FileContext& context) {
  const std::filesystem::path& path = context.path;
  // The file's axes are turned by UpAxis alone, so that one rule holds for every format.
  importer.SetPropertyBool(AI_CONFIG_IMPORT_COLLADA_IGNORE_UP_DIRECTION, true);
  importer.SetPropertyBool(AI_CONFIG_IMPORT_COLLADA_USE_COLLADA_NAMES, true);
  // NOLINTNEXTLINE(*-owning-memory): the importer owns it
  importer.SetIOHandler(new GuardedIo(context.options, context.format == MeshFormat::kObj));
  const aiScene* file = importer.ReadFile(path.string(), 0);
  if (!file) rethrow_own_error(importer);
  if (!file) throw FileError(path.string(), "cannot be read: " + std::string(importer.GetErrorString()));
  if ((file->mFlags & AI_SCENE_FLAGS_INCOMPLETE) || !file->mRootNode) {
    throw FileError(path.string(), "holds no complete scene");
  }
  check_indices(*file, path);
  file = importer.ApplyPostProcessing(aiProcess_TransformUVCoords);
  if (!file) throw FileError(path.string(), "holds no triangles");
  return *file;
}

/// Refuses damage that assimp does not survive.
void check_content(const FileContext& context) {
  if (context.format == MeshFormat::kPly) check_ply(context.path);
  if (context.format == MeshFormat::kDae) check_collada(context.path);
}

void convert_with_assimp(const FileContext& context, const UpAxis& up, Scene& scene) {
  check_content(context);
  const auto importer = make_importer();
  const aiScene& file = parse(*importer, context);
  convert_materials(file, context, scene);
  convert_nodes(file, context, up, scene);
}

ScenePtr import_mesh(const std::filesystem::path& path, const ImportOptions& options) {
  const MeshFormat format = mesh_format_of(path);
  check_limit(path.string(), "bytes", size_of_file(path), options.limits.file_bytes, "file_bytes");
  check_signature(path, format);
  const UpAxis up = up_axis_of(path, format, options.up);
  auto scene = std::make_shared<Scene>();
  scene->name = path.stem().string();
  scene->attributes["up"] = up.text();
  if (format == MeshFormat::kGlb || format == MeshFormat::kGltf) {
    convert_gltf(path, format, options, up, *scene);
  } else {
    convert_with_assimp({path, format, options}, up, *scene);
  }
  if (scene->instances.empty()) throw FileError(path.string(), "holds no triangles");
  check_imported(*scene, path);
  if (options.ceiling_height) add_ceiling(*scene, *options.ceiling_height);
  make_text_utf8(*scene);
  return scene;
}

}  // namespace

std::string importer_version() {
  return std::to_string(kImporterVersion) + ", cache " + std::to_string(kSceneCacheVersion) + ", assimp " +
         std::to_string(aiGetVersionMajor()) + "." + std::to_string(aiGetVersionMinor()) + "." +
         std::to_string(aiGetVersionPatch());
}

ScenePtr load_mesh(const std::filesystem::path& path, const ImportOptions& options) {
  return read_as_file(path, [&] { return import_mesh(path, options); });
}

}  // namespace wiw::scene
