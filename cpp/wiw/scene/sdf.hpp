// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <filesystem>

#include "wiw/scene/import.hpp"

namespace wiw::scene {

/// Reads a Gazebo world (.world or .sdf): every model, included or inline, becomes one instance; visuals that are
/// meshes, boxes, spheres, cylinders or planes are drawn, collision shapes are not. Models are looked for in
/// ImportOptions::model_folders, `../models`, `models`, the world's own folder and its parent. SDF is Z up:
/// (x, y, z) becomes (x, z, -y). What has to be left out is named in Scene::warnings.
/// Throws FileError for a missing or damaged file, or one above the limits.
ScenePtr load_sdf_world(const std::filesystem::path& path, const ImportOptions& options = {});

}  // namespace wiw::scene
