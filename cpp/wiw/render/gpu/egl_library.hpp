// SPDX-License-Identifier: Apache-2.0
#pragma once

#ifndef EGL_NO_X11
#define EGL_NO_X11
#endif
#include <EGL/egl.h>
#include <EGL/eglext.h>

#include <string>

namespace wiw::render::gpu {

/// The EGL entry points in use, opened at run time: a machine without any GL can still load this library.
struct EglLibrary {
  std::string path;  // what dlopen was given

  PFNEGLGETPROCADDRESSPROC get_proc_address = nullptr;
  PFNEGLGETERRORPROC get_error = nullptr;
  PFNEGLINITIALIZEPROC initialize = nullptr;
  PFNEGLQUERYSTRINGPROC query_string = nullptr;
  PFNEGLBINDAPIPROC bind_api = nullptr;
  PFNEGLQUERYAPIPROC query_api = nullptr;
  PFNEGLCHOOSECONFIGPROC choose_config = nullptr;
  PFNEGLCREATECONTEXTPROC create_context = nullptr;
  PFNEGLDESTROYCONTEXTPROC destroy_context = nullptr;
  PFNEGLMAKECURRENTPROC make_current = nullptr;
  PFNEGLGETCURRENTCONTEXTPROC get_current_context = nullptr;
  PFNEGLGETCURRENTDISPLAYPROC get_current_display = nullptr;
  PFNEGLGETCURRENTSURFACEPROC get_current_surface = nullptr;

  // Extensions; null where the library lacks them.
  PFNEGLGETPLATFORMDISPLAYEXTPROC get_platform_display = nullptr;
  PFNEGLQUERYDEVICESEXTPROC query_devices = nullptr;
  PFNEGLQUERYDEVICESTRINGEXTPROC query_device_string = nullptr;

  /// "EGL_BAD_ALLOC (0x3003)" for the calling thread's last error.
  [[nodiscard]] std::string last_error() const;
};

/// Opens libEGL.so.1, or the file that the environment variable WIW_EGL_LIBRARY names, once per process.
/// Throws BackendError naming the packages to install when it cannot be found.
const EglLibrary& egl_library();

/// Whether a space-separated extension list holds `name`; a null list is empty.
bool has_extension(const char* list, const char* name);

}  // namespace wiw::render::gpu
