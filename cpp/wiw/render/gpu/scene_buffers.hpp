// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <map>
#include <optional>
#include <vector>

#include "wiw/render/gpu/geometry.hpp"
#include "wiw/render/gpu/gl_context.hpp"
#include "wiw/render/gpu/program.hpp"
#include "wiw/render/gpu/uniform_slots.hpp"

namespace wiw::render::gpu {

/// The shaders' uniform block `Instance` (std140).
struct InstanceBlock {
  Eigen::Vector4f world_rows[3];
  Eigen::Vector4f normal_rows[3];
  std::uint32_t id[4];
};

/// The shaders' uniform block `Material` (std140).
struct MaterialBlock {
  Eigen::Vector4f base_color;
  Eigen::Vector4f cutoff;
};

/// A scene in graphics memory. Make, use and destroy while the context is current.
class SceneBuffers {
 public:
  /// Throws ArgumentError when a texture is larger than the driver takes.
  SceneBuffers(GlContext& context, const scene::Scene& scene, const SceneGeometry& geometry);

  void set_pose(std::uint32_t id, const Eigen::Affine3f& T_world_instance);

  void bind_geometry() const { gl_.BindVertexArray(vertex_array_.id()); }
  void bind_instance(std::size_t index) const { instances_.bind(kInstanceBinding, index); }
  void bind_material(std::int32_t index) const;
  void bind_texture(std::int32_t index) const;
  void bind_lightmap(std::int32_t index) const;

 private:
  void upload_geometry(const SceneGeometry& geometry);
  void upload_textures(const scene::Scene& scene, int max_size);

  const Gl& gl_;
  GlVertexArray vertex_array_;
  GlBuffer vertices_;
  GlBuffer indices_;
  UniformSlots<InstanceBlock> instances_;
  UniformSlots<MaterialBlock> materials_;  // slot 0: no material
  std::vector<GlTexture> textures_;
  std::map<scene::Sampling, std::optional<GlSampler>> samplers_;
  std::vector<GLuint> sampler_of_texture_;
  GlSampler lightmap_sampler_;
};

}  // namespace wiw::render::gpu
