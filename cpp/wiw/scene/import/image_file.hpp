// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstdint>
#include <functional>
#include <span>
#include <string>

#include "wiw/scene/scene.hpp"

namespace wiw::scene {

/// Decodes a `.basis` or KTX2 file to 8-bit RGBA, row 0 on top; throws Error with its reason.
using BasisDecoder = std::function<Texture(std::span<const std::uint8_t> bytes)>;

/// Whether an image is in Basis Universal, which takes a BasisDecoder.
bool is_basis(std::span<const std::uint8_t> bytes);

/// Size of a PNG, JPEG, BMP, TGA, WebP, KTX2 or `.basis` image from its header alone; throws Error with the decoder's
/// reason.
Size image_size(std::span<const std::uint8_t> bytes);

/// Decodes to 8-bit RGBA, row 0 on top; throws Error with the decoder's reason.
Texture decode_image(std::string name, std::span<const std::uint8_t> bytes, const BasisDecoder& decode_basis = {});

}  // namespace wiw::scene
