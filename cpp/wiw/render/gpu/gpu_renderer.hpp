// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <memory>
#include <string>
#include <vector>

#include "wiw/render/renderer.hpp"

namespace wiw::render {

/// OpenGL back end on the process's EGL device. Throws BackendError with the remedy when there is none.
std::shared_ptr<Renderer> make_gpu_renderer(scene::ScenePtr scene, const RenderOptions& options);

/// Whether an EGL device that is no software rasteriser gives a context here; opens one only on devices that may be
/// hardware. Throws BackendError if WIW_EGL_DEVICE names a device that does not exist.
bool has_gpu_hardware();

/// One EGL device as `wiw doctor` lists it. Where it gives no OpenGL context, `error` says why and the texts are empty.
struct EglDeviceReport {
  int index = -1;  // what WIW_EGL_DEVICE selects; -1: the surfaceless platform
  std::string vendor;
  std::string renderer;
  std::string version;
  bool software = false;
  std::string error;
};

/// Every EGL device, each tried. Throws BackendError when there is no EGL library.
std::vector<EglDeviceReport> report_egl_devices();

}  // namespace wiw::render
