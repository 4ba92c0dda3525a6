// SPDX-License-Identifier: Apache-2.0
#include <algorithm>

#include "wiw/core/error.hpp"
#include "wiw/render/gpu/gl_context.hpp"
#include "wiw/render/gpu/gpu_renderer.hpp"

namespace wiw {

bool has_gpu_hardware() {
  try {
    const auto devices = gpu::candidate_devices(gpu::egl_library());
    const auto may_be_hardware = [](const gpu::EglDevice& device) { return !device.marked_software; };
    // The surfaceless platform of a machine without hardware devices is Mesa's software rasteriser.
    if (std::ranges::none_of(devices,
                             [&](const auto& device) { return may_be_hardware(device) && device.index >= 0; })) {
      return false;
    }
    return !gpu::GlContext::shared()->info().software;
  } catch (const BackendError&) {
    return false;
  }
}

std::vector<EglDeviceReport> report_egl_devices() {
  const gpu::EglLibrary& egl = gpu::egl_library();
  std::vector<EglDeviceReport> reports;
  for (const gpu::EglDevice& device : gpu::list_devices(egl)) {
    EglDeviceReport report;
    report.index = device.index;
    report.software = device.marked_software;
    try {
      const gpu::GlContext context(egl, device);
      const gpu::GlContext::Info& info = context.info();
      report.vendor = info.vendor;
      report.renderer = info.renderer;
      report.version = info.version;
      report.software = info.software;
    } catch (const BackendError& error) {
      report.error = error.what();
    }
    reports.push_back(report);
  }
  return reports;
}

}  // namespace wiw
