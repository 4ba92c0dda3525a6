// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <filesystem>
#include <memory>
#include <string>

namespace Assimp {
class Importer;
}

namespace wiw::scene {

enum class MeshFormat { kGlb, kGltf, kObj, kPly, kDae };

/// ".glb, .gltf, .obj, .ply, .dae": for messages.
std::string supported_formats();

/// By extension, in either case; throws FileError listing what is supported.
MeshFormat mesh_format_of(const std::filesystem::path& path);

/// Throws FileError if the first bytes of the file cannot belong to `format`.
void check_signature(const std::filesystem::path& path, MeshFormat format);

/// An importer that knows the supported formats and no others, so that a file cannot reach the loaders of the many
/// formats that nobody here needs or tests.
std::unique_ptr<Assimp::Importer> make_importer();

}  // namespace wiw::scene
