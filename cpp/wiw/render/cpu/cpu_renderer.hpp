// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <memory>

#include "wiw/core/cpu.hpp"
#include "wiw/render/renderer.hpp"

namespace wiw::render {

/// Embree ray caster whose packets and shading use `isa`, which the processor must have; AVX-512 reads textures by
/// gather instructions if `gather`, to the same pixels. Throws ArgumentError for a scene without triangles.
std::shared_ptr<Renderer> make_cpu_renderer(scene::ScenePtr scene, const RenderOptions& options, Isa isa = active_isa(),
                                            bool gather = gathers_quickly());

}  // namespace wiw::render
