// SPDX-License-Identifier: Apache-2.0
// The one translation unit that holds stb_image's code; the project's warnings are off for it (see CMakeLists.txt).
#include <cstdlib>

// Zeros: a JPEG file that names tables which it does not bring is decoded by whatever is in memory in their place.
#define STBI_MALLOC(size) std::calloc(1, size)
#define STBI_REALLOC std::realloc
#define STBI_FREE std::free
#define STB_IMAGE_IMPLEMENTATION
#include "wiw/scene/import/stb_image.hpp"
