// SPDX-License-Identifier: Apache-2.0
#include "wiw/render/gpu/program.hpp"

#include <utility>

#include "wiw/core/error.hpp"

namespace wiw::render::gpu {

GLuint ProgramCache::find_or_make(ProgramKey key, const auto& make) {
  if (const auto entry = programs_.find(key); entry != programs_.end()) return entry->second;
  const GLuint program = make();
  programs_.emplace(key, program);
  return program;
}

GLuint ProgramCache::scene(ProgramKey key) {
  key = reduce(key);
  return find_or_make(key, [&] { return link("scene", scene_vertex_source(key), scene_fragment_source(key)); });
}

GLuint ProgramCache::sky(ProgramKey outputs) {
  return find_or_make(kSkyPass | outputs,
                      [&] { return link("sky", screen_vertex_source(), sky_fragment_source(outputs)); });
}

GLuint ProgramCache::average() {
  return find_or_make(kAveragePass, [&] { return link("average", screen_vertex_source(), average_fragment_source()); });
}

GLuint ProgramCache::panorama(ProgramKey key) {
  return find_or_make(kPanoramaPass | key,
                      [&] { return link("panorama", screen_vertex_source(), panorama_fragment_source(key)); });
}

GLuint ProgramCache::compile(const char* name, GLenum stage, const std::string& source) {
  const GLuint shader = gl_.CreateShader(stage);
  const char* text = source.c_str();
  gl_.ShaderSource(shader, 1, &text, nullptr);
  gl_.CompileShader(shader);
  GLint compiled = GL_FALSE;
  gl_.GetShaderiv(shader, GL_COMPILE_STATUS, &compiled);
  if (compiled == GL_TRUE) return shader;
  std::string log(4096, '\0');
  GLsizei length = 0;
  gl_.GetShaderInfoLog(shader, static_cast<GLsizei>(log.size()), &length, log.data());
  gl_.DeleteShader(shader);
  log.resize(static_cast<std::size_t>(length));
  throw BackendError(std::string("the OpenGL driver refuses the ") + name + " shader; update it. It says: " + log);
}

GLuint ProgramCache::link(const char* name, const std::string& vertex, const std::string& fragment) {
  const GLuint program = gl_.CreateProgram();
  for (const GLuint shader : {compile(name, GL_VERTEX_SHADER, vertex), compile(name, GL_FRAGMENT_SHADER, fragment)}) {
    gl_.AttachShader(program, shader);
    gl_.DeleteShader(shader);  // it lives on in the program
  }
  gl_.LinkProgram(program);
  GLint linked = GL_FALSE;
  gl_.GetProgramiv(program, GL_LINK_STATUS, &linked);
  if (linked != GL_TRUE) {
    std::string log(4096, '\0');
    GLsizei length = 0;
    gl_.GetProgramInfoLog(program, static_cast<GLsizei>(log.size()), &length, log.data());
    log.resize(static_cast<std::size_t>(length));
    throw BackendError(std::string("the OpenGL driver cannot link the ") + name +
                       " program; update it. It says: " + log);
  }
  bind_names(program);
  return program;
}

void ProgramCache::bind_names(GLuint program) {
  gl_.UseProgram(program);
  for (const auto& [block, binding] : {std::pair{"View", kViewBinding}, std::pair{"Instance", kInstanceBinding},
                                       std::pair{"Material", kMaterialBinding}, std::pair{"Sun", kSunBinding}}) {
    const GLuint index = gl_.GetUniformBlockIndex(program, block);
    if (index != GL_INVALID_INDEX) gl_.UniformBlockBinding(program, index, binding);
  }
  for (const auto& [sampler, unit] :
       {std::pair{"surface_texture", kColorUnit}, std::pair{"lightmap", kLightmapUnit},
        std::pair{"color_map", kColorUnit}, std::pair{"depth_map", kDepthUnit}, std::pair{"id_map", kIdUnit},
        std::pair{"slope_map", kSlopeUnit}, std::pair{"sun_map", kSunUnit}}) {
    gl_.Uniform1i(gl_.GetUniformLocation(program, sampler), unit);
  }
}

}  // namespace wiw::render::gpu
