// SPDX-License-Identifier: Apache-2.0
#include "wiw/render/cpu/kernel.hpp"
#define WIW_RENDER_GATHER
#include "wiw/render/cpu/simd_avx512.hpp"
// The lanes must be defined first.
#include "wiw/render/cpu/kernel_body.hpp"

namespace wiw::render::cpu {

void render_tile_avx512_gather(const KernelScene& scene, const KernelView& view, const ImageTargets& image,
                               const Tile& tile) {
  draw_tile(scene, view, image, tile);
}

}  // namespace wiw::render::cpu
