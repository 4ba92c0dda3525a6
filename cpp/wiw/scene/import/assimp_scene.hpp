// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <filesystem>

#include "wiw/scene/import.hpp"
#include "wiw/scene/import/mesh_format.hpp"
#include "wiw/scene/import/up_axis.hpp"

struct aiScene;

namespace wiw::scene {

/// Where a file came from and how it is to be read.
struct FileContext {
  const std::filesystem::path& path;
  MeshFormat format;
  const ImportOptions& options;
};

/// Materials and textures of the file, in its order.
void convert_materials(const aiScene& file, const FileContext& context, Scene& scene);

/// One mesh in the file's own axes; triangles without area are dropped. Throws FileError for damage.
Mesh convert_mesh(const aiScene& file, unsigned index, const FileContext& context, Scene& scene);

/// One instance per node that carries meshes, and the meshes with it, turned to Y up.
void convert_nodes(const aiScene& file, const FileContext& context, const UpAxis& up, Scene& scene);

}  // namespace wiw::scene
