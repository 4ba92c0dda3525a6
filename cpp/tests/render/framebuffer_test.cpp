// SPDX-License-Identifier: Apache-2.0
#include "wiw/render/gpu/framebuffer.hpp"

#include <doctest/doctest.h>

#include <map>
#include <utility>

using namespace wiw;
using namespace wiw::render;
using namespace wiw::render::gpu;

namespace {

/// A driver that only counts: texels of each texture, and an error where they would be more than it has room for.
struct Driver {
  std::map<GLuint, std::size_t> texels;
  std::size_t limit = std::size_t{1} << 40;
  GLuint bound = 0;
  GLuint last = 0;
  GLenum error = GL_NO_ERROR;
  int made = 0;

  [[nodiscard]] std::size_t held() const {
    std::size_t sum = 0;
    for (const auto& [_, count] : texels) sum += count;
    return sum;
  }
};
Driver driver;

void make(GLsizei count, GLuint* ids) {
  for (GLsizei i = 0; i < count; ++i) ids[i] = ++driver.last;
}

Gl counting_gl() {
  driver = {};
  Gl gl;
  gl.GenTextures = &make;
  gl.GenFramebuffers = &make;
  gl.DeleteTextures = [](GLsizei, const GLuint* ids) { driver.texels.erase(*ids); };
  gl.DeleteFramebuffers = [](GLsizei, const GLuint*) {};
  gl.ActiveTexture = [](GLenum) {};
  gl.BindTexture = [](GLenum, GLuint id) { driver.bound = id; };
  gl.TexParameteri = [](GLenum, GLenum, GLint) {};
  gl.TexImage3D = [](GLenum, GLint, GLint, GLsizei width, GLsizei height, GLsizei layers, GLint, GLenum, GLenum,
                     const void*) {
    const auto count = static_cast<std::size_t>(width) * static_cast<std::size_t>(height * layers);
    if (driver.held() + count > driver.limit) {
      driver.error = GL_OUT_OF_MEMORY;
      return;
    }
    driver.texels[driver.bound] = count;
    ++driver.made;
  };
  gl.GetError = [] { return std::exchange(driver.error, GLenum{GL_NO_ERROR}); };
  return gl;
}

}  // namespace

TEST_CASE("targets of one large image and of many small ones do not add up") {
  const Gl gl = counting_gl();
  Framebuffer target(gl);
  target.reserve({1024, 2048}, 1, kColorOut, false);
  target.reserve({16, 16}, 256, kColorOut, false);
  CHECK(driver.held() == 16 * 16 * 256);
  target.reserve({1024, 2048}, 1, kColorOut, false);
  CHECK(driver.held() == 1024 * 2048);
  target.reserve({8192, 8192}, 2, kColorOut, false);
  target.reserve({16, 16}, 1, kColorOut, false);
  CHECK(driver.held() == 16 * 16);
}

TEST_CASE("targets that fit are kept") {
  const Gl gl = counting_gl();
  Framebuffer target(gl);
  target.reserve({576, 1024}, 8, kColorOut, true);
  CHECK(driver.made == 2);
  for (const Size size : {Size{480, 480}, Size{576, 1024}, Size{16, 16}}) target.reserve(size, 8, kColorOut, true);
  target.reserve({576, 1024}, 1, kColorOut, false);
  CHECK(driver.made == 2);
  target.reserve({576, 1024}, 1, kColorOut | kDepthOut, false);
  CHECK(driver.made == 3);
}

TEST_CASE("a request the driver has no room for leaves nothing behind, and the next one is tried by itself") {
  const Gl gl = counting_gl();
  Framebuffer target(gl);
  driver.limit = 40000;
  CHECK_THROWS_AS(target.reserve({100, 100}, 5, kColorOut, false), OutOfGraphicsMemory);
  CHECK(driver.held() == 0);
  target.reserve({100, 100}, 3, kColorOut, false);
  target.reserve({10, 200}, 3, kColorOut, false);  // 100 x 200 x 3 would share its room, but does not fit
  CHECK(driver.held() == 10 * 200 * 3);
  target.reserve({100, 100}, 3, kColorOut, false);
  CHECK_THROWS_AS(target.reserve({100, 100}, 3, kColorOut | kDepthOut, false), OutOfGraphicsMemory);
  CHECK(driver.held() == 0);
  target.reserve({100, 100}, 1, kColorOut | kDepthOut, true);
  CHECK(driver.held() == 3 * 100 * 100);
}
