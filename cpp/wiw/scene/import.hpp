// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <filesystem>
#include <optional>
#include <string>
#include <vector>

#include "wiw/scene/import/image_file.hpp"
#include "wiw/scene/import/limits.hpp"
#include "wiw/scene/scene.hpp"

namespace wiw::scene {

/// Names the importer's behaviour: this code's version, the cache layout's and assimp's. Scenes imported under another
/// name are imported again.
std::string importer_version();

/// Which axis of the file points up. `kAuto` decides by the file, see `up_axis_of`.
enum class Up { kAuto, kY, kZ };

/// Every file an import read, and every file it looked for and did not find: a cached scene is stale when one of the
/// first has changed or one of the second has appeared.
struct ImportTrace {
  std::vector<std::filesystem::path> read;
  std::vector<std::filesystem::path> absent;
};

struct ImportOptions {
  Up up = Up::kAuto;
  ImportLimits limits;
  std::optional<float> ceiling_height;                 // metres above the floor; adds a ceiling over an open scene
  std::vector<std::filesystem::path> texture_folders;  // searched by base name after the file's own folders
  std::vector<std::filesystem::path> model_folders;    // SDF: searched for model://NAME before the world's own folders
  ImportTrace* trace = nullptr;
  BasisDecoder decode_basis;             // empty: images in Basis Universal are missing
  SharedCount* texture_bytes = nullptr;  // counted together by the files of one scene
};

/// Reads GLB, glTF, OBJ, PLY or DAE into a Y-up scene in metres: one instance per node that carries meshes, placed by
/// a rigid transform (scale and shear are applied to the vertices). glTF is read here, the others by assimp. A texture
/// that cannot be found or decoded is named in `Scene::warnings` and drawn in a neutral colour. Throws FileError for a
/// missing, damaged, unsupported or too large file.
ScenePtr load_mesh(const std::filesystem::path& path, const ImportOptions& options = {});

}  // namespace wiw::scene
