// SPDX-License-Identifier: Apache-2.0
#include <algorithm>

#include "wiw/core/error.hpp"
#include "wiw/render/gpu/gl_context.hpp"
#include "wiw/render/gpu/gpu_renderer.hpp"

namespace wiw::render {

bool has_gpu_hardware() {
  const gpu::EglLibrary* egl = nullptr;
  try {
    egl = &gpu::egl_library();
  } catch (const BackendError&) {
    return false;
  }
  if (gpu::list_devices(*egl).empty()) return false;
  const auto devices = gpu::candidate_devices(*egl);
  // The surfaceless platform of a machine without hardware devices is Mesa's software rasteriser.
  const auto may_be_hardware = [](const gpu::EglDevice& device) {
    return device.index >= 0 && !device.marked_software;
  };
  if (std::ranges::none_of(devices, may_be_hardware)) return false;
  if (gpu::GlContext::lost_to_fork()) return true;  // making a renderer then says what to do
  try {
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

}  // namespace wiw::render
