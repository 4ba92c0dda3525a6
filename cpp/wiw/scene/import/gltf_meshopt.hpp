// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstdint>
#include <filesystem>
#include <span>
#include <vector>

#include "wiw/scene/import/json.hpp"

namespace wiw::scene {

/// The bytes of a buffer view that EXT_meshopt_compression holds; `extension` says how. Throws FileError for settings
/// that the extension does not have and for damaged data.
std::vector<std::uint8_t> decode_meshopt(const Json& extension, std::span<const std::uint8_t> encoded,
                                         const std::filesystem::path& path);

}  // namespace wiw::scene
