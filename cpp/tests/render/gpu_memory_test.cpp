// SPDX-License-Identifier: Apache-2.0
#include <doctest/doctest.h>

#include <utility>

#include "render/furnished.hpp"
#include "render/scenes.hpp"
#include "wiw/core/error.hpp"
#include "wiw/render/gpu/gl_context.hpp"
#include "wiw/render/gpu/gpu_renderer.hpp"

using namespace wiw;
using namespace wiw::render;
using namespace wiw::testing;

namespace {

const Pose kHere = look({0, 1.2, 0}, 0.4, 0.0);
const Pose kThere = look({-1.2, 1.6, 1.4}, -0.8, -0.4);
const Pose kAway = look({1.5, 0.8, 1.0}, 2.5, 0.3);

bool available() {
  try {
    render::gpu::GlContext::shared();
    return true;
  } catch (const BackendError& error) {
    MESSAGE("skipped: " << error.what());
    return false;
  }
}

/// For its life, the shared context's driver has no memory for more than so many layers, as one that is nearly full.
class NearlyFull {
 public:
  explicit NearlyFull(int layers) : gl_(const_cast<render::gpu::Gl&>(context_->gl())), before_(gl_) {
    real_ = before_;
    most_ = layers;
    gl_.TexImage3D = [](GLenum target, GLint level, GLint internal, GLsizei width, GLsizei height, GLsizei count,
                        GLint border, GLenum format, GLenum type, const void* data) {
      if (count > most_) {
        error_ = GL_OUT_OF_MEMORY;
      } else {
        real_.TexImage3D(target, level, internal, width, height, count, border, format, type, data);
      }
    };
    gl_.GetError = [] {
      const GLenum error = std::exchange(error_, GLenum{GL_NO_ERROR});
      return error == GL_NO_ERROR ? real_.GetError() : error;
    };
  }
  ~NearlyFull() { gl_ = before_; }
  NearlyFull(const NearlyFull&) = delete;
  NearlyFull& operator=(const NearlyFull&) = delete;

 private:
  static inline render::gpu::Gl real_;
  static inline int most_ = 0;
  static inline GLenum error_ = GL_NO_ERROR;
  std::shared_ptr<render::gpu::GlContext> context_ = render::gpu::GlContext::shared();
  render::gpu::Gl& gl_;
  render::gpu::Gl before_;
};

}  // namespace

TEST_CASE("gpu: one large view, then many small ones, then a new renderer") {
  if (!available()) return;
  const auto renderer = make_gpu_renderer(make_furnished(), {});
  const Camera large{Projection::kPerspective, {1024, 2048}, radians(90)};
  const Camera small{Projection::kPerspective, {16, 16}, radians(90)};
  const Picture first = draw(*renderer, kHere, large);
  const std::vector<Pose> poses(256, kThere);
  std::vector<float> depth(small.size.pixels() * poses.size());
  renderer->render(poses, small, {.depth = depth.data()});
  const Picture one = draw(*make_gpu_renderer(make_furnished(), {}), kThere, small);
  CHECK(std::equal(one.depth.rbegin(), one.depth.rend(), depth.rbegin()));
  CHECK(draw(*renderer, kHere, large).color == first.color);
}

TEST_CASE("gpu: a batch too large for the driver is drawn in parts, and a view too large leaves the renderer usable") {
  if (!available()) return;
  const auto renderer = make_gpu_renderer(make_furnished(), {});
  const Camera camera{Projection::kPerspective, {200, 333}, radians(80)};  // of no size used before
  std::vector<Pose> poses(7, kHere);
  poses[3] = kThere;
  poses[6] = kAway;
  std::vector<std::uint32_t> whole(camera.size.pixels() * poses.size());
  std::vector<std::uint32_t> parts(whole.size());
  renderer->render(poses, camera, {.instance = whole.data()});
  draw(*renderer, kHere, {Projection::kPerspective, {3000, 3000}, radians(80)});  // gives the seven layers back
  {
    const NearlyFull driver(2);
    renderer->render(poses, camera, {.instance = parts.data()});
  }
  CHECK(parts == whole);
  draw(*renderer, kHere, {Projection::kPerspective, {3000, 3000}, radians(80)});
  {
    const NearlyFull driver(0);
    CHECK_THROWS_WITH_AS(renderer->render(poses, camera, {.instance = parts.data()}),
                         doctest::Contains("out of graphics memory"), BackendError);
  }
  renderer->render(poses, camera, {.instance = parts.data()});
  CHECK(parts == whole);
  CHECK(make_gpu_renderer(make_furnished(), {}) != nullptr);
}
