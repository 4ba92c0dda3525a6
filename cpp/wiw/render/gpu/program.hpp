// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <string>
#include <unordered_map>

#include "wiw/render/gpu/gl_api.hpp"
#include "wiw/render/gpu/shader_source.hpp"

namespace wiw::render::gpu {

// Where uniform blocks and textures are bound, the same in every program.
enum : GLuint { kViewBinding = 0, kInstanceBinding = 1, kMaterialBinding = 2, kSunBinding = 3 };
enum : GLint { kColorUnit = 0, kDepthUnit = 1, kIdUnit = 2, kSlopeUnit = 3, kLightmapUnit = 1, kSunUnit = 4 };

/// Compiles each program at its first use and keeps it: programs live as long as their context.
class ProgramCache {
 public:
  explicit ProgramCache(const Gl& gl) : gl_(gl) {}

  GLuint scene(ProgramKey key);
  GLuint sky(ProgramKey outputs);
  GLuint average();
  GLuint panorama(ProgramKey key);

  /// -1, which GL ignores, where the program does not use the uniform.
  [[nodiscard]] GLint uniform(GLuint program, const char* name) const { return gl_.GetUniformLocation(program, name); }

 private:
  // Key bits above those of scene programs.
  enum : ProgramKey { kSkyPass = 1u << 28, kAveragePass = 1u << 29, kPanoramaPass = 1u << 30 };

  GLuint find_or_make(ProgramKey key, const auto& make);
  GLuint compile(const char* name, GLenum stage, const std::string& source);
  GLuint link(const char* name, const std::string& vertex, const std::string& fragment);
  void bind_names(GLuint program);

  const Gl& gl_;
  std::unordered_map<ProgramKey, GLuint> programs_;
};

}  // namespace wiw::render::gpu
