// SPDX-License-Identifier: Apache-2.0
#include "wiw/render/gpu/gl_context.hpp"

#include <unistd.h>

#include <array>
#include <atomic>
#include <string_view>

#include "wiw/core/error.hpp"
#include "wiw/render/gpu/program.hpp"
#include "wiw/render/gpu/workspace.hpp"

namespace wiw::render::gpu {

namespace {

// Process that created the shared context; 0 before. A forked child inherits the value but none of the driver's
// threads, so every GL call in it may hang.
std::atomic<int> owner{0};

constexpr const char* kForked =
    "this process was forked after its parent had opened an OpenGL context, which does not survive a fork; start "
    "workers with multiprocessing's \"spawn\" method, or use backend=\"cpu\"";

void require_owner() {
  if (GlContext::lost_to_fork()) throw BackendError(kForked);
}

EGLDisplay open_display(const EglLibrary& egl, const EglDevice& device) {
  const bool surfaceless = device.index < 0;
  const EGLDisplay display = surfaceless
                                 ? egl.get_platform_display(EGL_PLATFORM_SURFACELESS_MESA, EGL_DEFAULT_DISPLAY, nullptr)
                                 : egl.get_platform_display(EGL_PLATFORM_DEVICE_EXT, device.handle, nullptr);
  if (display == EGL_NO_DISPLAY) throw BackendError("no display (" + egl.last_error() + ")");
  // Displays are shared by everything in the process that uses EGL, so they are never terminated.
  if (egl.initialize(display, nullptr, nullptr) != EGL_TRUE) {
    throw BackendError("eglInitialize failed (" + egl.last_error() + "); is the device file readable?");
  }
  return display;
}

EGLContext open_context(const EglLibrary& egl, EGLDisplay display) {
  const char* extensions = egl.query_string(display, EGL_EXTENSIONS);
  if (!has_extension(extensions, "EGL_KHR_surfaceless_context")) {
    throw BackendError("the driver lacks EGL_KHR_surfaceless_context; update it");
  }
  EGLConfig config = nullptr;  // EGL_NO_CONFIG_KHR
  if (!has_extension(extensions, "EGL_KHR_no_config_context")) {
    static constexpr std::array<EGLint, 5> kWanted{EGL_SURFACE_TYPE, EGL_PBUFFER_BIT, EGL_RENDERABLE_TYPE,
                                                   EGL_OPENGL_BIT, EGL_NONE};
    EGLint count = 0;
    if (egl.choose_config(display, kWanted.data(), &config, 1, &count) != EGL_TRUE || count == 0) {
      throw BackendError("no EGL configuration renders desktop OpenGL");
    }
  }
  static constexpr std::array<EGLint, 7> kCore{
      EGL_CONTEXT_MAJOR_VERSION,           3,       EGL_CONTEXT_MINOR_VERSION, 3, EGL_CONTEXT_OPENGL_PROFILE_MASK,
      EGL_CONTEXT_OPENGL_CORE_PROFILE_BIT, EGL_NONE};
  const EGLContext context = egl.create_context(display, config, EGL_NO_CONTEXT, kCore.data());
  if (context == EGL_NO_CONTEXT) {
    throw BackendError("no OpenGL 3.3 core context (" + egl.last_error() + ")");
  }
  return context;
}

std::shared_ptr<GlContext> create_best() {
  const EglLibrary& egl = egl_library();
  std::string failures;
  for (const EglDevice& device : candidate_devices(egl)) {
    try {
      return std::make_shared<GlContext>(egl, device);
    } catch (const BackendError& error) {
      failures += "; " + device_name(device) + ": " + error.what();
    }
  }
  throw BackendError("no EGL device gives an OpenGL context" + failures + "; see `wiw doctor`, or use backend=\"cpu\"");
}

}  // namespace

bool GlContext::lost_to_fork() {
  const int process = owner.load();
  return process != 0 && process != getpid();
}

std::shared_ptr<GlContext> GlContext::shared() {
  static std::mutex mutex;
  // Never destroyed: at exit the driver may already be gone.
  static auto& context = *new std::shared_ptr<GlContext>;
  require_owner();
  const std::scoped_lock lock(mutex);
  if (!context || context->lost_) {
    context = create_best();
    owner = getpid();
  }
  return context;
}

GlContext::GlContext(const EglLibrary& egl, const EglDevice& device) : egl_(egl), process_(getpid()) {
  require_owner();
  const EGLenum api = egl_.query_api();
  try {
    create(device);
  } catch (...) {
    if (context_ != EGL_NO_CONTEXT) egl_.destroy_context(display_, context_);
    egl_.bind_api(api);
    throw;
  }
  egl_.bind_api(api);
}

void GlContext::create(const EglDevice& device) {
  display_ = open_display(egl_, device);
  if (egl_.bind_api(EGL_OPENGL_API) != EGL_TRUE) throw BackendError("the EGL library has no desktop OpenGL");
  context_ = open_context(egl_, display_);
  const Current current(*this);
  load_functions();
  read_info();
  info_.software = info_.software || device.marked_software;
  programs_ = std::make_unique<ProgramCache>(gl_);
  workspace_ = std::make_unique<Workspace>(gl_);
}

GlContext::~GlContext() {
  if (process_ != getpid() || context_ == EGL_NO_CONTEXT) return;
  egl_.destroy_context(display_, context_);
}

void GlContext::load_functions() {
  const auto load = [this](const char* name, auto& function) {
    const std::string full = std::string("gl") + name;
    function = reinterpret_cast<std::remove_reference_t<decltype(function)>>(egl_.get_proc_address(full.c_str()));
    if (function == nullptr) throw BackendError("the driver lacks " + full);
  };
#define WIW_GL_LOAD(name, type) load(#name, gl_.name);
  WIW_GL_FUNCTIONS(WIW_GL_LOAD)
#undef WIW_GL_LOAD
}

void GlContext::read_info() {
  const auto text = [this](GLenum name) { return reinterpret_cast<const char*>(gl_.GetString(name)); };
  const auto number = [this](GLenum name) {
    GLint value = 0;
    gl_.GetIntegerv(name, &value);
    return value;
  };
  info_.vendor = text(GL_VENDOR);
  info_.renderer = text(GL_RENDERER);
  info_.version = text(GL_VERSION);
  info_.max_texture_size = number(GL_MAX_TEXTURE_SIZE);
  info_.uniform_alignment = number(GL_UNIFORM_BUFFER_OFFSET_ALIGNMENT);
  for (const char* name : {"llvmpipe", "softpipe", "swrast", "SwiftShader"}) {
    info_.software = info_.software || info_.renderer.find(name) != std::string::npos;
  }
  bool clip_control = false;
  for (GLint i = 0; i < number(GL_NUM_EXTENSIONS); ++i) {
    const auto* name = reinterpret_cast<const char*>(gl_.GetStringi(GL_EXTENSIONS, static_cast<GLuint>(i)));
    clip_control = clip_control || std::string_view(name) == "GL_ARB_clip_control";
  }
  if (!clip_control) throw BackendError(info_.renderer + " lacks GL_ARB_clip_control (OpenGL 4.5); update its driver");
}

void GlContext::require_own_process() const {
  if (process_ != getpid()) throw BackendError(kForked);
}

void GlContext::check(const char* doing) {
  const GLenum code = gl_.GetError();
  if (code == GL_NO_ERROR) return;
  if (code == GL_CONTEXT_LOST) lost_ = true;
  if (code == GL_OUT_OF_MEMORY) throw OutOfGraphicsMemory(std::string(doing) + " on " + info_.renderer);
  std::string cause = "OpenGL error " + std::to_string(code);
  if (code == GL_CONTEXT_LOST) cause = "the OpenGL context was lost; make a new renderer";
  throw BackendError(std::string(doing) + " on " + info_.renderer + ": " + cause);
}

void GlContext::discard_errors() {
  constexpr int kMostFlags = 16;  // a driver may keep several, each of which is reported once
  for (int i = 0; i < kMostFlags && gl_.GetError != nullptr; ++i) {
    const GLenum code = gl_.GetError();
    if (code == GL_NO_ERROR) return;
    if (code == GL_CONTEXT_LOST) lost_ = true;
  }
}

GlContext::Current::Current(GlContext& context)
    : context_((context.require_own_process(), context)),
      lock_(context.mutex_),
      api_(context.egl_.query_api()),
      display_(context.egl_.get_current_display()),
      draw_(context.egl_.get_current_surface(EGL_DRAW)),
      read_(context.egl_.get_current_surface(EGL_READ)),
      previous_(context.egl_.get_current_context()) {
  const EglLibrary& egl = context.egl_;
  egl.bind_api(EGL_OPENGL_API);
  if (context.lost_ ||
      egl.make_current(context.display_, EGL_NO_SURFACE, EGL_NO_SURFACE, context.context_) != EGL_TRUE) {
    const std::string cause = context.lost_ ? "it was lost" : egl.last_error();
    context.lost_ = true;
    egl.bind_api(api_);
    throw BackendError("cannot use the OpenGL context (" + cause + "); make a new renderer");
  }
}

GlContext::Current::~Current() {
  // What an exception left behind must not be taken for a failure of the next call.
  context_.discard_errors();
  const EglLibrary& egl = context_.egl_;
  if (previous_ == EGL_NO_CONTEXT) {
    egl.make_current(context_.display_, EGL_NO_SURFACE, EGL_NO_SURFACE, EGL_NO_CONTEXT);
  } else {
    egl.make_current(display_, draw_, read_, previous_);
  }
  egl.bind_api(api_);
}

}  // namespace wiw::render::gpu
