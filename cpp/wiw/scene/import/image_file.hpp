// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstdint>
#include <span>
#include <string>

#include "wiw/scene/scene.hpp"

namespace wiw::scene {

/// Size of a PNG, JPEG, BMP or TGA image from its header alone; throws Error with the decoder's reason.
Size image_size(std::span<const std::uint8_t> bytes);

/// Decodes to 8-bit RGBA, row 0 on top; throws Error with the decoder's reason.
Texture decode_image(std::string name, std::span<const std::uint8_t> bytes);

}  // namespace wiw::scene
