// SPDX-License-Identifier: Apache-2.0
#include "wiw/render/renderer.hpp"

#include <utility>

#include "wiw/core/error.hpp"
#include "wiw/render/cpu/cpu_renderer.hpp"
#include "wiw/render/gpu/gpu_renderer.hpp"

namespace wiw::render {

std::shared_ptr<Renderer> make_renderer(scene::ScenePtr scene, Backend backend, const RenderOptions& options) {
  if (scene == nullptr) throw ArgumentError("make_renderer: expected a scene, got none");
  if (backend == Backend::kGpu || (backend == Backend::kAuto && has_gpu_hardware())) {
    return make_gpu_renderer(std::move(scene), options);
  }
  return make_cpu_renderer(std::move(scene), options);
}

}  // namespace wiw::render
