// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <filesystem>
#include <string>
#include <vector>

#include "wiw/scene/import.hpp"
#include "wiw/scene/import/gltf_document.hpp"

namespace wiw::scene {

/// Checks what the readers of a glTF document take for granted. Returns warnings that name extensions which nobody
/// reads. Throws FileError for versions other than 2, for required extensions that are not read, for accessors that
/// reach beyond their buffers and for nodes that grow without bound.
std::vector<std::string> check_gltf(const GltfDocument& document, const std::filesystem::path& path,
                                    const ImportLimits& limits);

}  // namespace wiw::scene
