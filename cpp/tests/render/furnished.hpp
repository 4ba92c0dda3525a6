// SPDX-License-Identifier: Apache-2.0
#pragma once

#include "wiw/render/renderer.hpp"

namespace wiw::testing {

/// A room without a ceiling that has one of every kind of surface: textured floor and walls, a lightmap, a smooth
/// sphere, a box with vertex colours, an emissive panel, a cutout screen, a mesh of many chunks, a scaled placement.
scene::ScenePtr make_furnished();

constexpr std::uint32_t kFurnishedSphere = 6;

/// The same under a sun that reaches the floor over the open ceiling.
scene::ScenePtr make_sunny();

/// Six tiles whose textures go on beyond their edges, each in another way; three are not interpolated from near by.
scene::ScenePtr make_tiled();

}  // namespace wiw::testing
