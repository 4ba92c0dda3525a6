// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <Eigen/Geometry>
#include <cstddef>
#include <cstdint>
#include <vector>

#include "wiw/render/gpu/shader_source.hpp"
#include "wiw/scene/scene.hpp"

namespace wiw::render::gpu {

/// Vertex as the graphics card reads it, 40 bytes.
struct Vertex {
  float position[3];
  std::int16_t normal[4];  // signed normalised
  float uv[2];
  float lightmap_uv[2];  // of a mesh lit by the sun: its greatest lift around the vertex (shading.hpp), and nothing
  std::uint8_t color[4];
};
static_assert(sizeof(Vertex) == 40);

/// Nearby triangles of one mesh, culled together.
struct MeshChunk {
  Eigen::AlignedBox3f box;  // instance coordinates
  std::size_t first_index = 0;
  std::size_t index_count = 0;
};

/// Triangles culled together; smaller ones cost draw calls, larger ones draw what is out of sight.
constexpr std::size_t kChunkTriangles = 4096;

struct MeshRange {
  Eigen::AlignedBox3f box;
  std::size_t first_chunk = 0;
  std::size_t chunk_count = 0;
  ProgramKey appearance = 0;
  std::int32_t material = scene::kNone;
  std::int32_t texture = scene::kNone;
  std::int32_t lightmap = scene::kNone;
};

/// All meshes of a scene in one vertex and one index array.
struct SceneGeometry {
  std::vector<Vertex> vertices;
  std::vector<std::uint32_t> indices;
  std::vector<MeshChunk> chunks;
  std::vector<MeshRange> meshes;  // parallel to Scene::meshes
};

SceneGeometry build_geometry(const scene::Scene& scene);

}  // namespace wiw::render::gpu
