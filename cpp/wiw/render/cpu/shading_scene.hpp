// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <map>
#include <optional>
#include <span>
#include <tuple>
#include <vector>

#include "wiw/render/cpu/texture_store.hpp"

namespace wiw::render::cpu {

/// One mesh of one instance, called a part here: the unit of geometry, numbered alike in Embree.
struct InstanceMesh {
  std::uint32_t instance = 0;  // index into Scene::instances
  std::uint32_t mesh = 0;
  std::uint32_t surface = 0;
  std::uint32_t first_record = 0;
  std::uint32_t first_detail = kNoDetail;
};

/// What the kernels shade with: one record a placed triangle, surfaces, and textures with their mip levels.
class ShadingScene {
 public:
  explicit ShadingScene(const scene::Scene& scene);

  [[nodiscard]] std::span<const InstanceMesh> parts() const { return parts_; }
  [[nodiscard]] const ShadingSurface& surface(const InstanceMesh& part) const { return surfaces_[part.surface]; }
  [[nodiscard]] const TriangleRecord* records(const InstanceMesh& part) const {
    return records_.data() + part.first_record;
  }

  /// Number of a triangle's record among its part's. Its details and its primitive of Embree have the same one.
  [[nodiscard]] std::size_t place_of(const InstanceMesh& part, std::size_t triangle) const {
    const std::vector<std::uint32_t>& order = orders_[part.mesh];
    return order.empty() ? triangle : order[triangle];
  }
  [[nodiscard]] bool is_reordered(const InstanceMesh& part) const { return !orders_[part.mesh].empty(); }

  /// Recomputes what depends on a part's pose: world normals, bulges and texel densities.
  void place(std::size_t part, const Eigen::Affine3f& T_world_instance);

  /// Fills everything but the Embree scenes, with pointers into this object.
  void describe(KernelScene& kernel) const;

 private:
  using SurfaceKey = std::tuple<std::int32_t, std::int32_t, bool, bool>;  // material, lightmap, textured, colours
  std::uint32_t add_surface(const scene::Mesh& mesh);
  const SampledTexture* add_texture(std::int32_t index, TextureStore::Use use);
  void add_parts();
  void place_texels(std::size_t part, const Eigen::Matrix3f& linear);
  void place_bulges(std::size_t part, const Eigen::Matrix3f& linear);

  const scene::Scene& scene_;
  Sunlight sun_{};  // if the scene has one
  std::map<std::pair<std::int32_t, TextureStore::Use>, std::unique_ptr<TextureStore>> textures_;
  std::map<SurfaceKey, std::uint32_t> surface_numbers_;
  std::vector<ShadingSurface> surfaces_;
  std::vector<InstanceMesh> parts_;
  std::vector<std::uint32_t> first_record_;  // by part
  std::vector<TriangleRecord> records_;
  std::vector<std::vector<std::uint32_t>> orders_;  // by mesh: places of its triangles; empty: their own
  std::vector<TriangleDetail> details_;
  std::vector<std::optional<Eigen::Matrix3f>> stretches_;  // by part: what its bulges are of
};

}  // namespace wiw::render::cpu
