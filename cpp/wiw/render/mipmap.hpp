// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstdint>
#include <vector>

#include "wiw/core/image.hpp"
#include "wiw/scene/scene.hpp"

namespace wiw::render {

struct MipLevel {
  Size size;
  std::vector<std::uint8_t> rgba;  // [height, width, 4]
};

/// Mip levels 1, 2, ... of a texture down to 1 x 1 (level 0 is the texture itself), at most `kMaxMipLevels` in all.
/// Each side halves, rounding down; every texel is the area-weighted mean of the texels it covers, on the encoded
/// values, so odd sizes neither shift nor drop rows.
std::vector<MipLevel> build_mips(const scene::Texture& texture);

}  // namespace wiw::render
