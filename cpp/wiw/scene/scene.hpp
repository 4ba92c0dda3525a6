// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <Eigen/Geometry>
#include <compare>
#include <cstdint>
#include <map>
#include <memory>
#include <optional>
#include <string>
#include <vector>

#include "wiw/core/buffer.hpp"
#include "wiw/core/image.hpp"
#include "wiw/scene/triangle.hpp"

namespace wiw::scene {

/// How a texture goes on beyond its edges.
enum class Wrap : std::uint8_t { kRepeat, kClamp, kMirror };

struct Sampling {
  Wrap u = Wrap::kRepeat;
  Wrap v = Wrap::kRepeat;
  bool nearest = false;  // seen from near by, a texel is a square of one colour; mip levels are smooth all the same
  auto operator<=>(const Sampling&) const = default;
};

/// 8-bit RGBA image, display-encoded (sRGB-like), row 0 at the top; texture coordinate v = 0 is the TOP edge.
/// Lightmaps are clamped and smooth, whatever `sampling` says.
struct Texture {
  std::string name;
  Size size;
  Buffer<std::uint8_t> rgba;  // [height, width, 4]
  Sampling sampling;
};

constexpr std::int32_t kNone = -1;

/// Surface appearance. The displayed colour of a point is, per channel and in display-encoded space,
///   base_color x texture(uv) x vertex colour x light,
/// where light is 2 x lightmap(lightmap_uv) if the mesh has one (128 is neutral, so light may brighten up to 2),
/// 1 if `emissive`, and otherwise the renderer's analytic ambient light (a function of the normal alone), to which a
/// scene with a `Sun` adds its direct light.
/// Multiplying encoded values is exact for a pure power-law display encoding, so no conversion is needed per pixel.
struct Material {
  std::string name;
  Eigen::Vector4f base_color = Eigen::Vector4f::Ones();
  std::int32_t texture = kNone;
  float alpha_cutoff = -1.f;  // a texel with alpha below this is a hole; negative: opaque, alpha ignored
  bool emissive = false;
  bool texture_missing = false;  // the file names a texture that could not be had; a neutral colour is drawn
};

/// Indexed triangles of one material in instance coordinates. Optional arrays are empty or as long as `positions`.
struct Mesh {
  Buffer<Eigen::Vector3f> positions;
  Buffer<Eigen::Vector3f> normals;  // unit length; empty: the geometric normal is used
  Buffer<Eigen::Vector2f> uv;
  Buffer<Eigen::Vector2f> lightmap_uv;
  Buffer<Eigen::Matrix<std::uint8_t, 4, 1>> colors;
  Buffer<Triangle> triangles;
  std::int32_t material = kNone;
  std::int32_t lightmap = kNone;  // index into Scene::textures
};

/// One placed object. `id` is what the renderer writes into the instance image; 0 means "nothing hit" and is never an
/// id.
struct Instance {
  std::uint32_t id = 0;
  std::string name;
  std::int32_t category = kNone;  // index into Scene::categories
  std::vector<std::uint32_t> meshes;
  Eigen::Affine3f T_world_instance = Eigen::Affine3f::Identity();
  std::map<std::string, std::string>
      attributes;  // "color": "red", "material": "wood", "state": "open", "room": "kitchen 1"
};

struct Room {
  std::string name;  // "bedroom 2"
  std::string type;  // "bedroom"
  Eigen::AlignedBox3f bounds;
};

/// What a ray that hits nothing shows: a vertical gradient; depth 0 and instance 0.
struct Sky {
  Eigen::Vector3f zenith{0.45f, 0.62f, 0.86f};
  Eigen::Vector3f horizon{0.86f, 0.90f, 0.94f};
};

/// One directional light that casts shadows, for scenes whose instances move, where no lightmap can be baked. Surfaces
/// with a lightmap have their light already and emissive ones need none: both ignore the sun, but everything casts
/// shadows, on both sides. `light` of the other materials becomes
///   min(1, ambient x analytic ambient light + strength x max(0, cosine to the normal) x visibility).
struct Sun {
  Eigen::Vector3f direction{0.36f, 0.80f, 0.48f};  // towards the light, unit length
  float strength = 0.6f;                           // of the direct light, in [0, 1]
  float ambient = 0.55f;                           // share of the ambient light that is left, in [0, 1]
};

/// What the placements of a scene may sum to: ten times what importers allow by default, and few enough to be numbered
/// in 32 bits. A placement costs a few bytes where the whole scene is read, and its mesh where a soup is made of it.
constexpr std::size_t kMostPlacedTriangles = 500'000'000;
constexpr std::size_t kMostPlacedVertices = 3 * kMostPlacedTriangles;

/// A whole scene in memory: plain data, immutable once built, shared by renderers, navigation meshes and environments.
/// World frame: metres, Y up, right-handed.
struct Scene {
  std::string name;
  std::vector<Texture> textures;
  std::vector<Material> materials;
  std::vector<Mesh> meshes;
  std::vector<Instance> instances;      // instances[i].id == i + 1
  std::vector<std::string> categories;  // unique, lower case
  std::vector<Room> rooms;              // empty where unknown
  Sky sky;
  std::optional<Sun> sun;
  std::map<std::string, std::string> attributes;  // "up": "Z (by file header)", "split": "val", ...
  std::vector<std::string> warnings;              // what the importer had to leave out, one sentence each

  [[nodiscard]] std::size_t triangle_count() const;  // over placements
  [[nodiscard]] Eigen::AlignedBox3f bounds() const;  // world
  /// Throws ArgumentError naming the first broken invariant (index out of range, array length, a position or pose that
  /// is not finite, a sun out of its ranges, placements beyond kMostPlacedTriangles or kMostPlacedVertices).
  void validate() const;
};

using ScenePtr = std::shared_ptr<const Scene>;

/// World-space triangle soup of all placements, e.g. for a navigation mesh.
struct TriangleSoup {
  std::vector<Eigen::Vector3f> vertices;
  std::vector<Triangle> triangles;
  std::vector<std::uint32_t> instance;  // per triangle: Instance::id
};
TriangleSoup world_triangles(const Scene& scene);

}  // namespace wiw::scene
