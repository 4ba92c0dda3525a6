// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <vector>

#include "wiw/apartment/atlas.hpp"
#include "wiw/apartment/ray_tracer.hpp"

namespace wiw::apartment {

/// Point of a surface whose light is wanted.
struct Sample {
  Vec3 position, normal;
  std::int32_t room = kOutside;
  std::uint32_t phase = 0;  // selects one of kPhases parts of the sampling pattern
};
constexpr std::uint32_t kPhases = 16;

/// Diffuse light transport in one apartment: direct light from lamps and windows, one traced bounce, and a constant
/// per room for the bounces after it. Light is in units in which a surface shows its albedo times the light, linear.
class LightSolver {
 public:
  LightSolver(const Draft& draft, const Atlas& atlas, const std::vector<scene::Texture>& textures,
              const BounceRays& rays = {});

  /// Charts' texels in the atlas's order, then the vertices of all objects' parts in order.
  [[nodiscard]] const std::vector<Sample>& samples() const { return samples_; }
  [[nodiscard]] std::vector<Rgb> solve(ThreadPool& pool) const;

 private:
  struct Face {
    Rgb albedo;
    std::int32_t chart = scene::kNone;        // its light is in the chart's texels, or
    std::array<std::uint32_t, 3> vertices{};  // at these samples
  };
  /// A light that reaches a room: directly, or through an opening to the room it stands in.
  struct VisibleLight {
    std::size_t light;
    const Opening* through = nullptr;
  };
  void add_texels(const Draft& draft);
  void add_object(const Draft& draft, const Object& object, const std::vector<Rgb>& albedo);
  void add_vertices(const Submesh& part, const Object& object);
  void place_targets();
  void find_reach(const Draft& draft);
  [[nodiscard]] Rgb direct(const Sample& sample) const;
  [[nodiscard]] Rgb from_light(const Sample& sample, const VisibleLight& lit) const;
  /// Light after one bounce, seen along directions around the sample's normal.
  [[nodiscard]] Rgb bounced(const Sample& sample, const std::vector<Vec3x16>& hemisphere,
                            const std::vector<Rgb>& direct_light, const std::vector<Rgb>& ambient) const;
  [[nodiscard]] std::vector<Rgb> ambient(const std::vector<Rgb>& direct_light, std::size_t rooms) const;

  const Atlas& atlas_;
  const std::vector<Chart>& charts_;
  std::vector<Light> lights_;
  std::vector<std::array<Vec3x16, kPhases>> targets_;     // points on each light
  std::vector<std::vector<VisibleLight>> lit_;            // by room
  std::array<std::vector<Vec3x16>, kPhases> texel_rays_;  // around Z, of the bounce
  std::vector<Vec3x16> vertex_rays_;
  std::vector<Sample> samples_;
  std::vector<Face> faces_;
  std::vector<std::int32_t> face_room_;
  std::vector<Vec3> vertices_;
  std::vector<scene::Triangle> triangles_;
  std::unique_ptr<RayTracer> tracer_;
};

}  // namespace wiw::apartment
