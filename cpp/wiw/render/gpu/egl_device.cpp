// SPDX-License-Identifier: Apache-2.0
#include "wiw/render/gpu/egl_device.hpp"

#include <algorithm>
#include <cstdlib>

#include "wiw/core/error.hpp"

namespace wiw::render::gpu {

std::vector<EglDevice> list_devices(const EglLibrary& egl) {
  std::vector<EglDevice> devices;
  if (egl.get_platform_display == nullptr) return devices;
  const char* client_extensions = egl.query_string(EGL_NO_DISPLAY, EGL_EXTENSIONS);
  EGLint count = 0;
  if (egl.query_devices != nullptr && has_extension(client_extensions, "EGL_EXT_platform_device") &&
      egl.query_devices(0, nullptr, &count) == EGL_TRUE && count > 0) {
    std::vector<EGLDeviceEXT> handles(static_cast<std::size_t>(count));
    egl.query_devices(count, handles.data(), &count);
    for (int i = 0; i < count; ++i) {
      const EGLDeviceEXT handle = handles[static_cast<std::size_t>(i)];
      const char* extensions =
          egl.query_device_string == nullptr ? nullptr : egl.query_device_string(handle, EGL_EXTENSIONS);
      devices.push_back({i, handle, has_extension(extensions, "EGL_MESA_device_software")});
    }
  }
  if (has_extension(client_extensions, "EGL_MESA_platform_surfaceless")) devices.push_back({});
  return devices;
}

std::vector<EglDevice> candidate_devices(const EglLibrary& egl) {
  std::vector<EglDevice> devices = list_devices(egl);
  if (devices.empty()) {
    throw BackendError("EGL (" + egl.path +
                       ") offers no device; on Debian: apt install libegl-mesa0 libgl1-mesa-dri (software) or the GPU "
                       "vendor's driver; or use backend=\"cpu\"");
  }
  if (const char* wanted = std::getenv("WIW_EGL_DEVICE"); wanted != nullptr && *wanted != '\0') {
    char* end = nullptr;
    const long index = std::strtol(wanted, &end, 10);
    std::erase_if(devices, [&](const EglDevice& device) { return *end != '\0' || device.index != index; });
    if (devices.empty()) {
      throw BackendError(std::string("WIW_EGL_DEVICE=") + wanted +
                         ": no such EGL device; `wiw doctor` lists them (-1 is the surfaceless platform)");
    }
    return devices;
  }
  const auto rank = [](const EglDevice& device) { return device.index < 0 ? 2 : device.marked_software ? 1 : 0; };
  std::ranges::stable_sort(devices, {}, rank);
  return devices;
}

std::string device_name(const EglDevice& device) {
  return device.index < 0 ? "the surfaceless platform" : "EGL device " + std::to_string(device.index);
}

}  // namespace wiw::render::gpu
