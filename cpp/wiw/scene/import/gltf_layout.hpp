// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstddef>
#include <optional>
#include <string>

#include "wiw/scene/import/json.hpp"

namespace wiw::scene {

/// Checks that every accessor of a glTF document lies inside its buffer view, every view inside its buffer, and that
/// accessors which are read side by side have as many elements as each other, so that readers need not. Animations,
/// which nobody reads, may be damaged. `body` is the length of a GLB's binary chunk. Throws FileError naming the entry
/// that does not fit.
void check_gltf_layout(const Json& document, std::optional<std::size_t> body, const std::string& path);

}  // namespace wiw::scene
