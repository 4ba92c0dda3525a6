// SPDX-License-Identifier: Apache-2.0
#include "wiw/render/gpu/egl_library.hpp"

#include <dlfcn.h>

#include <array>
#include <cstdio>
#include <cstdlib>
#include <string_view>
#include <utility>

#include "wiw/core/error.hpp"

namespace wiw::render::gpu {

namespace {

template <class Function>
void load(void* library, const std::string& name, Function& function) {
  function = reinterpret_cast<Function>(dlsym(library, name.c_str()));
  if (function == nullptr) throw BackendError(name + " is missing from the EGL library; expected EGL 1.4 or newer");
}

EglLibrary open_library() {
  const char* wanted = std::getenv("WIW_EGL_LIBRARY");
  EglLibrary egl;
  egl.path = wanted != nullptr && *wanted != '\0' ? wanted : "libEGL.so.1";
  void* library = dlopen(egl.path.c_str(), RTLD_NOW | RTLD_LOCAL);
  if (library == nullptr) {
    throw BackendError("the gpu back end needs " + egl.path + ", which cannot be opened (" + dlerror() +
                       "); on Debian: apt install libegl1 libegl-mesa0 libgl1-mesa-dri (software) or the GPU vendor's "
                       "driver; or use backend=\"cpu\"");
  }
  load(library, "eglGetProcAddress", egl.get_proc_address);
  load(library, "eglGetError", egl.get_error);
  load(library, "eglInitialize", egl.initialize);
  load(library, "eglQueryString", egl.query_string);
  load(library, "eglBindAPI", egl.bind_api);
  load(library, "eglQueryAPI", egl.query_api);
  load(library, "eglChooseConfig", egl.choose_config);
  load(library, "eglCreateContext", egl.create_context);
  load(library, "eglDestroyContext", egl.destroy_context);
  load(library, "eglMakeCurrent", egl.make_current);
  load(library, "eglGetCurrentContext", egl.get_current_context);
  load(library, "eglGetCurrentDisplay", egl.get_current_display);
  load(library, "eglGetCurrentSurface", egl.get_current_surface);

  const auto extension = [&](const char* name, auto& function) {
    function = reinterpret_cast<std::remove_reference_t<decltype(function)>>(egl.get_proc_address(name));
  };
  extension("eglGetPlatformDisplayEXT", egl.get_platform_display);
  extension("eglQueryDevicesEXT", egl.query_devices);
  extension("eglQueryDeviceStringEXT", egl.query_device_string);
  return egl;
}

}  // namespace

std::string EglLibrary::last_error() const {
  static constexpr std::array<std::pair<EGLint, const char*>, 15> kNames{{
      {EGL_SUCCESS, "EGL_SUCCESS"},
      {EGL_NOT_INITIALIZED, "EGL_NOT_INITIALIZED"},
      {EGL_BAD_ACCESS, "EGL_BAD_ACCESS"},
      {EGL_BAD_ALLOC, "EGL_BAD_ALLOC"},
      {EGL_BAD_ATTRIBUTE, "EGL_BAD_ATTRIBUTE"},
      {EGL_BAD_CONFIG, "EGL_BAD_CONFIG"},
      {EGL_BAD_CONTEXT, "EGL_BAD_CONTEXT"},
      {EGL_BAD_CURRENT_SURFACE, "EGL_BAD_CURRENT_SURFACE"},
      {EGL_BAD_DISPLAY, "EGL_BAD_DISPLAY"},
      {EGL_BAD_SURFACE, "EGL_BAD_SURFACE"},
      {EGL_BAD_MATCH, "EGL_BAD_MATCH"},
      {EGL_BAD_PARAMETER, "EGL_BAD_PARAMETER"},
      {EGL_BAD_NATIVE_PIXMAP, "EGL_BAD_NATIVE_PIXMAP"},
      {EGL_BAD_NATIVE_WINDOW, "EGL_BAD_NATIVE_WINDOW"},
      {EGL_CONTEXT_LOST, "EGL_CONTEXT_LOST"},
  }};
  const EGLint code = get_error();
  const char* name = "EGL error";
  for (const auto& [value, text] : kNames) {
    if (value == code) name = text;
  }
  std::array<char, 16> hex{};
  std::snprintf(hex.data(), hex.size(), " (0x%04X)", static_cast<unsigned>(code));
  return std::string(name) + hex.data();
}

const EglLibrary& egl_library() {
  static const EglLibrary library = open_library();
  return library;
}

bool has_extension(const char* list, const char* name) {
  if (list == nullptr) return false;
  std::string_view rest(list);
  while (!rest.empty()) {
    const std::size_t end = rest.find(' ');
    if (rest.substr(0, end) == name) return true;
    if (end == std::string_view::npos) break;
    rest.remove_prefix(end + 1);
  }
  return false;
}

}  // namespace wiw::render::gpu
