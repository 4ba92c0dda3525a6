// SPDX-License-Identifier: Apache-2.0
#include "wiw/render/renderer.hpp"

#include "wiw/core/error.hpp"
#include "wiw/render/cpu/cpu_renderer.hpp"

namespace wiw {

std::shared_ptr<Renderer> make_renderer(ScenePtr scene, Backend backend, const RenderOptions& options) {
  if (scene == nullptr) throw ArgumentError("make_renderer: expected a scene, got none");
  if (backend == Backend::kGpu) {
    throw BackendError("render: this build has no GPU back end; use backend=\"cpu\"");
  }
  return make_cpu_renderer(std::move(scene), options);
}

}  // namespace wiw
