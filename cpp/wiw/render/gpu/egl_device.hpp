// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <string>
#include <vector>

#include "wiw/render/gpu/egl_library.hpp"

namespace wiw::render::gpu {

/// One way to reach a GL implementation without a window system.
struct EglDevice {
  int index = -1;  // position in eglQueryDevicesEXT, what WIW_EGL_DEVICE selects; -1: Mesa's surfaceless platform
  EGLDeviceEXT handle = EGL_NO_DEVICE_EXT;
  bool marked_software = false;  // the driver says so itself (EGL_MESA_device_software)
};

/// All devices, in the order of eglQueryDevicesEXT, then the surfaceless platform where the library has it.
/// Empty when the library has neither. Throws BackendError when there is no EGL library.
std::vector<EglDevice> list_devices(const EglLibrary& egl);

/// The devices to try, best first: the one that WIW_EGL_DEVICE names and no other, else hardware before software before
/// surfaceless. Throws BackendError when that is none.
std::vector<EglDevice> candidate_devices(const EglLibrary& egl);

/// "EGL device 0" or "the surfaceless platform".
std::string device_name(const EglDevice& device);

}  // namespace wiw::render::gpu
