// SPDX-License-Identifier: Apache-2.0
// The one translation unit that holds stb_image's code; the project's warnings are off for it (see CMakeLists.txt).
#define STB_IMAGE_IMPLEMENTATION
#include "wiw/scene/import/stb_image.hpp"
