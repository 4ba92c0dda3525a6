// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstdint>
#include <string>

namespace wiw::render::gpu {

// Properties of a surface and of a pass that a scene program is compiled for; a ProgramKey is their union.
enum : std::uint32_t {
  kTextured = 1u << 0,
  kLightmapped = 1u << 1,
  kEmissive = 1u << 2,
  kVertexColors = 1u << 3,
  kCutout = 1u << 4,
  kSmooth = 1u << 5,     // has vertex normals
  kColorOut = 1u << 6,   // the pass writes colour,
  kDepthOut = 1u << 7,   // metric depth,
  kIdOut = 1u << 8,      // instance ids
  kCubeFace = 1u << 9,   // the pass draws one face of a panorama
  kSampled = 1u << 10,   // the pass averages several rays a pixel
  kSunlit = 1u << 11,    // lit by the scene's sun
  kParallel = 1u << 12,  // the pass draws depths along the sun's direction
};
using ProgramKey = std::uint32_t;

/// `key` without the properties that change nothing in that pass, so that equal programs are compiled once.
ProgramKey reduce(ProgramKey key);

// GLSL of every program. A pass over the whole target draws one triangle from three vertex numbers without buffers.
std::string scene_vertex_source(ProgramKey key);
std::string scene_fragment_source(ProgramKey key);
std::string screen_vertex_source();
std::string sky_fragment_source(ProgramKey outputs);
std::string average_fragment_source();
std::string panorama_fragment_source(ProgramKey key);

}  // namespace wiw::render::gpu
