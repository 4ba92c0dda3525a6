// SPDX-License-Identifier: Apache-2.0
// The one translation unit that holds stb_image's code; the project's warnings are off for it (see CMakeLists.txt).
#include <cstddef>
#include <cstdlib>

namespace {

thread_local std::size_t most_bytes = 0;

void* grow(void* buffer, std::size_t size) { return size <= most_bytes ? std::realloc(buffer, size) : nullptr; }

}  // namespace

// Zeros: a JPEG file that names tables which it does not bring is decoded by whatever is in memory in their place.
#define STBI_MALLOC(size) std::calloc(1, size)
#define STBI_REALLOC grow
#define STBI_FREE std::free
#define STB_IMAGE_IMPLEMENTATION
#include "wiw/scene/import/stb_image.hpp"

namespace wiw::scene {

void bound_stb_buffers(std::size_t bytes) { most_bytes = bytes; }

}  // namespace wiw::scene
