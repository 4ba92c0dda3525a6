// SPDX-License-Identifier: Apache-2.0
#pragma once

#include "wiw/render/gpu/framebuffer.hpp"

namespace wiw::render::gpu {

/// Targets of a render call: the views of a batch, the faces of one panorama, the samples of one view.
struct Workspace {
  explicit Workspace(const Gl& gl) : batch(gl), faces(gl), samples(gl), packed(gl) {}

  /// Gives all graphics memory back.
  void release() {
    for (Framebuffer* target : {&batch, &faces, &samples}) target->release();
    packed = {};
  }

  Framebuffer batch;
  Framebuffer faces;
  Framebuffer samples;
  GlBuffer packed;  // what is read back
};

}  // namespace wiw::render::gpu
