// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstdint>
#include <filesystem>

#include "wiw/scene/scene.hpp"

namespace wiw::scene {

/// Changes whenever the layout of a cache file does; files of another version are refused.
inline constexpr std::uint32_t kSceneCacheVersion = 5;

/// Writes a scene, textures included, to one file: a header, the arrays at 64-byte boundaries as they lie in memory,
/// and a table that says which is which. Geometry carries checksums, and so do header and table together. The file
/// appears under its name whole (written beside it, brought to the disk, then renamed), so other processes may read and
/// write the same path at the same time and a power cut leaves all of it or nothing.
/// Throws FileError if it cannot be written.
void write_scene_cache(const Scene& scene, const std::filesystem::path& path);

/// Maps such a file read-only: the scene's arrays are views of the mapping, shared with every other process that maps
/// it, and stay valid when the file is replaced or removed. Geometry is verified, because what it indexes is
/// trusted; textures, which are most of a file, are held to their size alone and read when they are used. Throws
/// FileError for a file that is missing, truncated, damaged or of another version; the caller then builds the scene
/// again.
ScenePtr map_scene_cache(const std::filesystem::path& path);

}  // namespace wiw::scene
