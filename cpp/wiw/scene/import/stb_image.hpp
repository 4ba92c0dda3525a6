// SPDX-License-Identifier: Apache-2.0
#pragma once

// Only the decoders that textures of the supported mesh formats use, from memory only.
#define STBI_ONLY_PNG
#define STBI_ONLY_JPEG
#define STBI_ONLY_BMP
#define STBI_ONLY_TGA
#define STBI_NO_STDIO
#define STBI_MAX_DIMENSIONS 65536
#include <stb/stb_image.h>

#include <cstddef>

namespace wiw::scene {

/// Sets how far buffers of stb may grow in this thread. Nothing else bounds what a picture of few pixels inflates to.
void bound_stb_buffers(std::size_t bytes);

}  // namespace wiw::scene
