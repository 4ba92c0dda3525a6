// SPDX-License-Identifier: Apache-2.0
#include "wiw/render/gpu/geometry.hpp"

#include <algorithm>
#include <array>
#include <cmath>
#include <limits>
#include <numeric>
#include <span>
#include <string>

#include "wiw/core/error.hpp"
#include "wiw/render/bulge.hpp"
#include "wiw/render/shading.hpp"

namespace wiw::render::gpu {

namespace {

Vertex make_vertex(const scene::Mesh& mesh, std::size_t i) {
  Vertex vertex{};
  Eigen::Map<Eigen::Vector3f>(vertex.position) = mesh.positions[i];
  if (!mesh.normals.empty()) {
    for (int k = 0; k < 3; ++k) {
      vertex.normal[k] = static_cast<std::int16_t>(std::lround(std::clamp(mesh.normals[i][k], -1.f, 1.f) * 32767.f));
    }
  }
  if (!mesh.uv.empty()) Eigen::Map<Eigen::Vector2f>(vertex.uv) = mesh.uv[i];
  if (!mesh.lightmap_uv.empty()) Eigen::Map<Eigen::Vector2f>(vertex.lightmap_uv) = mesh.lightmap_uv[i];
  if (!mesh.colors.empty()) Eigen::Map<Eigen::Matrix<std::uint8_t, 4, 1>>(vertex.color) = mesh.colors[i];
  return vertex;
}

void set_appearance(const scene::Scene& scene, const scene::Mesh& mesh, MeshRange& range) {
  static const scene::Material kDefault;
  const scene::Material& material =
      mesh.material == scene::kNone ? kDefault : scene.materials[static_cast<std::size_t>(mesh.material)];
  range.material = mesh.material;
  if (material.texture != scene::kNone && !mesh.uv.empty()) {
    range.texture = material.texture;
    range.appearance |= kTextured;
  }
  if (mesh.lightmap != scene::kNone && !mesh.lightmap_uv.empty()) {
    range.lightmap = mesh.lightmap;
    range.appearance |= kLightmapped;
  }
  if (material.emissive) range.appearance |= kEmissive;
  if (scene.sun && (range.appearance & (kLightmapped | kEmissive)) == 0) range.appearance |= kSunlit;
  if (material.alpha_cutoff >= 0) range.appearance |= kCutout;
  if (!mesh.colors.empty()) range.appearance |= kVertexColors;
  if (!mesh.normals.empty()) range.appearance |= kSmooth;
}

/// Writes how far a curved surface stands out of the triangles around each of its vertices.
void write_lifts(const scene::Mesh& mesh, std::span<Vertex> vertices) {
  for (Vertex& vertex : vertices) vertex.lightmap_uv[0] = 0.f;
  for (const auto& triangle : mesh.triangles) {
    std::array<Eigen::Vector3f, 3> corners;
    std::array<Eigen::Vector3f, 3> normals;
    for (std::size_t i = 0; i < 3; ++i) {
      corners[i] = mesh.positions[triangle[static_cast<Eigen::Index>(i)]];
      normals[i] = mesh.normals[triangle[static_cast<Eigen::Index>(i)]];
    }
    const float lift = shading::kGreatestLift * triangle_bulge(corners, normals);
    for (const std::uint32_t i : triangle) vertices[i].lightmap_uv[0] = std::max(vertices[i].lightmap_uv[0], lift);
  }
}

/// Splits the triangles of one mesh at the median of the longest side until a part is small enough.
class Splitter {
 public:
  Splitter(const scene::Mesh& mesh, std::uint32_t first_vertex, SceneGeometry& geometry)
      : mesh_(mesh), first_vertex_(first_vertex), geometry_(geometry), order_(mesh.triangles.size()) {
    centres_.reserve(order_.size());
    for (const auto& triangle : mesh.triangles) {
      centres_.emplace_back((mesh.positions[triangle[0]] + mesh.positions[triangle[1]] + mesh.positions[triangle[2]]) /
                            3.f);
    }
    std::iota(order_.begin(), order_.end(), 0u);
  }

  void run() {
    if (!order_.empty()) split(order_);
  }

 private:
  void split(std::span<std::uint32_t> part) {
    if (part.size() <= kChunkTriangles) return emit(part);
    Eigen::AlignedBox3f box;
    for (const std::uint32_t i : part) box.extend(centres_[i]);
    Eigen::Index axis = 0;
    box.sizes().maxCoeff(&axis);
    const std::size_t half = part.size() / 2;
    std::ranges::nth_element(part, part.begin() + static_cast<std::ptrdiff_t>(half), {},
                             [&](std::uint32_t i) { return centres_[i][axis]; });
    split(part.first(half));
    split(part.subspan(half));
  }

  void emit(std::span<std::uint32_t> part) {
    std::ranges::sort(part);  // the file's order keeps neighbouring vertices close in memory
    MeshChunk chunk;
    chunk.first_index = geometry_.indices.size();
    chunk.index_count = 3 * part.size();
    for (const std::uint32_t i : part) {
      for (const std::uint32_t vertex : mesh_.triangles[i]) {
        chunk.box.extend(mesh_.positions[vertex]);
        geometry_.indices.push_back(first_vertex_ + vertex);
      }
    }
    geometry_.chunks.push_back(chunk);
  }

  const scene::Mesh& mesh_;
  std::uint32_t first_vertex_;
  SceneGeometry& geometry_;
  std::vector<std::uint32_t> order_;
  std::vector<Eigen::Vector3f> centres_;
};

}  // namespace

SceneGeometry build_geometry(const scene::Scene& scene) {
  SceneGeometry geometry;
  std::size_t vertices = 0;
  for (const scene::Mesh& mesh : scene.meshes) vertices += mesh.positions.size();
  if (vertices > std::numeric_limits<std::uint32_t>::max()) {
    throw ArgumentError("the gpu back end draws at most 2^32 vertices, got " + std::to_string(vertices));
  }
  geometry.vertices.reserve(vertices);
  for (const scene::Mesh& mesh : scene.meshes) {
    MeshRange range;
    range.first_chunk = geometry.chunks.size();
    const auto first_vertex = static_cast<std::uint32_t>(geometry.vertices.size());
    for (std::size_t i = 0; i < mesh.positions.size(); ++i) geometry.vertices.push_back(make_vertex(mesh, i));
    Splitter(mesh, first_vertex, geometry).run();
    range.chunk_count = geometry.chunks.size() - range.first_chunk;
    for (std::size_t i = 0; i < range.chunk_count; ++i) range.box.extend(geometry.chunks[range.first_chunk + i].box);
    set_appearance(scene, mesh, range);
    if ((range.appearance & kSunlit) != 0 && (range.appearance & kSmooth) != 0) {
      write_lifts(mesh, std::span(geometry.vertices).subspan(first_vertex));
    }
    geometry.meshes.push_back(range);
  }
  return geometry;
}

}  // namespace wiw::render::gpu
