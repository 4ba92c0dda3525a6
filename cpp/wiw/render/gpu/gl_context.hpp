// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <atomic>
#include <memory>
#include <mutex>
#include <string>

#include "wiw/render/gpu/egl_device.hpp"
#include "wiw/render/gpu/gl_api.hpp"

namespace wiw::render::gpu {

class ProgramCache;
struct Workspace;

/// One OpenGL core context (3.3 or newer, with ARB_clip_control) without any window or surface.
class GlContext {
 public:
  /// What the driver says about itself.
  struct Info {
    std::string vendor;
    std::string renderer;
    std::string version;
    bool software = false;
    int max_texture_size = 0;
    int uniform_alignment = 0;
  };

  /// The process's context, created on the best device at the first call and kept for the life of the process; a lost
  /// context is replaced. Throws BackendError with the remedy, also in a child forked after the context was created.
  static std::shared_ptr<GlContext> shared();

  /// Whether this process was forked after its parent had opened the shared context.
  static bool lost_to_fork();

  GlContext(const EglLibrary& egl, const EglDevice& device);
  ~GlContext();
  GlContext(const GlContext&) = delete;
  GlContext& operator=(const GlContext&) = delete;

  /// Makes the context current on this thread for its own lifetime, waits for other threads first, and puts back
  /// whatever context the thread had.
  class Current {
   public:
    explicit Current(GlContext& context);
    ~Current();
    Current(const Current&) = delete;
    Current& operator=(const Current&) = delete;

   private:
    GlContext& context_;
    std::unique_lock<std::mutex> lock_;
    EGLenum api_;
    EGLDisplay display_;
    EGLSurface draw_;
    EGLSurface read_;
    EGLContext previous_;
  };

  [[nodiscard]] const Gl& gl() const { return gl_; }
  [[nodiscard]] const Info& info() const { return info_; }
  /// Compiled programs, shared by all renderers of the context; use while current.
  [[nodiscard]] ProgramCache& programs() { return *programs_; }

  /// Render targets, shared likewise: calls are serialised, so one set serves all.
  [[nodiscard]] Workspace& workspace() { return *workspace_; }

  /// Throws BackendError naming `doing` if a GL call failed since the last check, OutOfGraphicsMemory if that was why;
  /// use while current.
  void check(const char* doing);

 private:
  void create(const EglDevice& device);
  void load_functions();
  void read_info();
  void require_own_process() const;
  void discard_errors();

  const EglLibrary& egl_;
  Gl gl_;
  Info info_;
  std::unique_ptr<ProgramCache> programs_;
  std::unique_ptr<Workspace> workspace_;
  std::mutex mutex_;
  EGLDisplay display_ = EGL_NO_DISPLAY;
  EGLContext context_ = EGL_NO_CONTEXT;
  int process_ = 0;  // the one that created it
  std::atomic<bool> lost_ = false;
};

}  // namespace wiw::render::gpu
