// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <filesystem>

#include "wiw/scene/import.hpp"
#include "wiw/scene/import/mesh_format.hpp"
#include "wiw/scene/import/up_axis.hpp"

namespace wiw::scene {

/// Reads a GLB or glTF 2.0 file into a scene: an instance for each node that shows a mesh, and for each of
/// EXT_mesh_gpu_instancing, with morph weights and skins as the file leaves them. What cannot be drawn is named in
/// warnings. Throws FileError for damage, for limits that are passed and for required extensions that are not read.
void convert_gltf(const std::filesystem::path& path, MeshFormat format, const ImportOptions& options, const UpAxis& up,
                  Scene& scene);

}  // namespace wiw::scene
