// SPDX-License-Identifier: Apache-2.0
#include "wiw/render/cpu/kernel.hpp"
#include "wiw/render/cpu/simd_avx2.hpp"
// The lanes must be defined first.
#include "wiw/render/cpu/kernel_body.hpp"

namespace wiw::cpu {

void render_tile_avx2(const KernelScene& scene, const View& view, const Image& image, const Tile& tile) {
  draw_tile(scene, view, image, tile);
}

}  // namespace wiw::cpu
