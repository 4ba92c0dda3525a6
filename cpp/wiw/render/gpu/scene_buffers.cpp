// SPDX-License-Identifier: Apache-2.0
#include "wiw/render/gpu/scene_buffers.hpp"

#include <cstddef>
#include <string>

#include "wiw/core/error.hpp"
#include "wiw/render/mipmap.hpp"

namespace wiw::render::gpu {

namespace {

InstanceBlock make_instance(std::uint32_t id, const Eigen::Affine3f& T_world_instance) {
  InstanceBlock block{};
  // Normals transform by the inverse transpose, up to scale; the cofactor matrix is that and exists for flat scales
  // too.
  const Eigen::Matrix3f linear = T_world_instance.linear();
  Eigen::Matrix3f cofactor;
  cofactor << linear.col(1).cross(linear.col(2)), linear.col(2).cross(linear.col(0)),
      linear.col(0).cross(linear.col(1));
  for (int i = 0; i < 3; ++i) {
    block.world_rows[i] = T_world_instance.matrix().row(i);
    block.normal_rows[i].head<3>() = cofactor.row(i);
  }
  block.id[0] = id;
  return block;
}

void upload_level(const Gl& gl, int level, Size size, const std::uint8_t* rgba) {
  gl.TexImage2D(GL_TEXTURE_2D, level, GL_RGBA8, size.width, size.height, 0, GL_RGBA, GL_UNSIGNED_BYTE, rgba);
}

GLint wrap_mode(scene::Wrap wrap) {
  switch (wrap) {
    case scene::Wrap::kRepeat: return GL_REPEAT;
    case scene::Wrap::kClamp: return GL_CLAMP_TO_EDGE;
    case scene::Wrap::kMirror: return GL_MIRRORED_REPEAT;
  }
  return GL_REPEAT;
}

GlSampler make_sampler(const Gl& gl, GLint minify, const scene::Sampling& sampling) {
  GlSampler sampler(gl);
  gl.SamplerParameteri(sampler.id(), GL_TEXTURE_MIN_FILTER, minify);
  gl.SamplerParameteri(sampler.id(), GL_TEXTURE_MAG_FILTER, sampling.nearest ? GL_NEAREST : GL_LINEAR);
  gl.SamplerParameteri(sampler.id(), GL_TEXTURE_WRAP_S, wrap_mode(sampling.u));
  gl.SamplerParameteri(sampler.id(), GL_TEXTURE_WRAP_T, wrap_mode(sampling.v));
  return sampler;
}

constexpr scene::Sampling kLightmapSampling{scene::Wrap::kClamp, scene::Wrap::kClamp, false};

}  // namespace

SceneBuffers::SceneBuffers(GlContext& context, const scene::Scene& scene, const SceneGeometry& geometry)
    : gl_(context.gl()),
      vertex_array_(gl_),
      vertices_(gl_),
      indices_(gl_),
      instances_(gl_, context.info().uniform_alignment),
      materials_(gl_, context.info().uniform_alignment),
      lightmap_sampler_(make_sampler(gl_, GL_LINEAR, kLightmapSampling)) {
  upload_geometry(geometry);
  std::vector<InstanceBlock> instances;
  instances.reserve(scene.instances.size());
  for (const scene::Instance& instance : scene.instances) {
    instances.push_back(make_instance(instance.id, instance.T_world_instance));
  }
  instances_.upload(instances, GL_DYNAMIC_DRAW);
  std::vector<MaterialBlock> materials;
  materials.reserve(scene.materials.size() + 1);
  materials.push_back({Eigen::Vector4f::Ones(), Eigen::Vector4f::Zero()});
  for (const scene::Material& material : scene.materials) {
    materials.push_back({material.base_color, Eigen::Vector4f::Constant(material.alpha_cutoff)});
  }
  materials_.upload(materials, GL_STATIC_DRAW);
  upload_textures(scene, context.info().max_texture_size);
  context.check("uploading the scene");
}

void SceneBuffers::upload_geometry(const SceneGeometry& geometry) {
  gl_.BindVertexArray(vertex_array_.id());
  gl_.BindBuffer(GL_ARRAY_BUFFER, vertices_.id());
  gl_.BufferData(GL_ARRAY_BUFFER, static_cast<GLsizeiptr>(geometry.vertices.size() * sizeof(Vertex)),
                 geometry.vertices.data(), GL_STATIC_DRAW);
  gl_.BindBuffer(GL_ELEMENT_ARRAY_BUFFER, indices_.id());
  gl_.BufferData(GL_ELEMENT_ARRAY_BUFFER, static_cast<GLsizeiptr>(geometry.indices.size() * sizeof(std::uint32_t)),
                 geometry.indices.data(), GL_STATIC_DRAW);
  const auto attribute = [&](GLuint location, GLint count, GLenum type, std::size_t offset) {
    const GLboolean normalised = type == GL_FLOAT ? GL_FALSE : GL_TRUE;
    gl_.EnableVertexAttribArray(location);
    gl_.VertexAttribPointer(location, count, type, normalised, sizeof(Vertex), buffer_offset(offset));
  };
  attribute(0, 3, GL_FLOAT, offsetof(Vertex, position));
  attribute(1, 3, GL_SHORT, offsetof(Vertex, normal));
  attribute(2, 2, GL_FLOAT, offsetof(Vertex, uv));
  attribute(3, 2, GL_FLOAT, offsetof(Vertex, lightmap_uv));
  attribute(4, 4, GL_UNSIGNED_BYTE, offsetof(Vertex, color));
  gl_.BindVertexArray(0);
}

void SceneBuffers::upload_textures(const scene::Scene& scene, int max_size) {
  std::vector<bool> needs_mips(scene.textures.size(), false);
  for (const scene::Material& material : scene.materials) {
    if (material.texture != scene::kNone) needs_mips[static_cast<std::size_t>(material.texture)] = true;
  }
  gl_.ActiveTexture(GL_TEXTURE0);
  for (std::size_t i = 0; i < scene.textures.size(); ++i) {
    const scene::Texture& texture = scene.textures[i];
    if (texture.size.width > max_size || texture.size.height > max_size) {
      throw ArgumentError("texture '" + texture.name + "' is " + std::to_string(texture.size.height) + " x " +
                          std::to_string(texture.size.width) + ", but this OpenGL driver takes at most " +
                          std::to_string(max_size) + "; shrink it or use backend=\"cpu\"");
    }
    gl_.BindTexture(GL_TEXTURE_2D, textures_.emplace_back(gl_).id());
    upload_level(gl_, 0, texture.size, texture.rgba.data());
    int level = 0;
    if (needs_mips[i]) {
      for (const MipLevel& mip : build_mips(texture)) upload_level(gl_, ++level, mip.size, mip.rgba.data());
    }
    gl_.TexParameteri(GL_TEXTURE_2D, GL_TEXTURE_MAX_LEVEL, level);
    auto& sampler = samplers_[texture.sampling];
    if (!sampler) sampler = make_sampler(gl_, GL_LINEAR_MIPMAP_LINEAR, texture.sampling);
    sampler_of_texture_.push_back(sampler->id());
  }
}

void SceneBuffers::set_pose(std::uint32_t id, const Eigen::Affine3f& T_world_instance) {
  instances_.replace(id - 1, make_instance(id, T_world_instance));
}

void SceneBuffers::bind_material(std::int32_t index) const {
  materials_.bind(kMaterialBinding, static_cast<std::size_t>(std::int64_t{index} + 1));
}

void SceneBuffers::bind_texture(std::int32_t index) const {
  gl_.ActiveTexture(GL_TEXTURE0 + kColorUnit);
  gl_.BindTexture(GL_TEXTURE_2D, textures_[static_cast<std::size_t>(index)].id());
  gl_.BindSampler(kColorUnit, sampler_of_texture_[static_cast<std::size_t>(index)]);
}

void SceneBuffers::bind_lightmap(std::int32_t index) const {
  gl_.ActiveTexture(GL_TEXTURE0 + kLightmapUnit);
  gl_.BindTexture(GL_TEXTURE_2D, textures_[static_cast<std::size_t>(index)].id());
  gl_.BindSampler(kLightmapUnit, lightmap_sampler_.id());
}

}  // namespace wiw::render::gpu
