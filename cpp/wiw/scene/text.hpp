// SPDX-License-Identifier: Apache-2.0
#pragma once

#include "wiw/scene/scene.hpp"

namespace wiw::scene {

/// Makes all names, attributes and warnings UTF-8; bytes that are not are taken as Latin-1.
void make_text_utf8(Scene& scene);

}  // namespace wiw::scene
