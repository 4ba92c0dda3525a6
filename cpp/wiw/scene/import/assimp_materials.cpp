// SPDX-License-Identifier: Apache-2.0
#include <assimp/GltfMaterial.h>
#include <assimp/scene.h>

#include <algorithm>
#include <cmath>

#include "wiw/scene/import/assimp_scene.hpp"
#include "wiw/scene/import/texture_source.hpp"

namespace wiw::scene {
namespace {

constexpr float kNeutral = 0.7f;  // stands in for a texture that is missing

/// glTF factors are linear light; the scene multiplies display-encoded values (a pure power law).
float encoded(float linear) { return std::pow(std::clamp(linear, 0.f, 1.f), 1.f / 2.2f); }

bool is_gltf(MeshFormat format) { return format == MeshFormat::kGlb || format == MeshFormat::kGltf; }

/// Emission of a glTF material whose base colour is black; black for all others.
aiColor4D emitted_color(const aiMaterial& material, MeshFormat format) {
  aiColor4D base(1, 1, 1, 1);
  aiColor4D light(0, 0, 0, 1);
  material.Get(AI_MATKEY_BASE_COLOR, base);
  material.Get(AI_MATKEY_COLOR_EMISSIVE, light);
  const bool is_black = base.r <= 0 && base.g <= 0 && base.b <= 0;
  return is_gltf(format) && is_black ? aiColor4D(light.r, light.g, light.b, base.a) : aiColor4D(0, 0, 0, 1);
}

bool is_emissive(const aiColor4D& light) { return light.r > 0 || light.g > 0 || light.b > 0; }

std::string texture_reference(const aiMaterial& material, MeshFormat format) {
  aiString path;
  const bool is_light = is_emissive(emitted_color(material, format));
  for (const aiTextureType type : {aiTextureType_BASE_COLOR, aiTextureType_DIFFUSE, aiTextureType_EMISSIVE}) {
    if (is_light && type != aiTextureType_EMISSIVE) continue;
    if (material.GetTexture(type, 0, &path) == aiReturn_SUCCESS && path.length > 0) return path.C_Str();
  }
  return {};
}

Eigen::Vector4f gltf_color(const aiMaterial& material) {
  aiColor4D color(1, 1, 1, 1);
  material.Get(AI_MATKEY_BASE_COLOR, color);
  const aiColor4D light = emitted_color(material, MeshFormat::kGltf);
  if (is_emissive(light)) color = light;
  return {encoded(color.r), encoded(color.g), encoded(color.b), std::clamp(color.a, 0.f, 1.f)};
}

Eigen::Vector4f diffuse_color(const aiMaterial& material) {
  aiColor4D color(kNeutral, kNeutral, kNeutral, 1);
  material.Get(AI_MATKEY_COLOR_DIFFUSE, color);
  return Eigen::Vector4f(color.r, color.g, color.b, 1.f).cwiseMax(0.f).cwiseMin(1.f);
}

/// Texture alpha counts only where the material says that it is transparent: many exporters leave junk in it. Blending
/// is drawn as a cut-out at one half.
float alpha_cutoff(const aiMaterial& material, MeshFormat format) {
  if (is_gltf(format)) {
    aiString mode("OPAQUE");
    float cutoff = 0.5f;
    material.Get(AI_MATKEY_GLTF_ALPHAMODE, mode);
    material.Get(AI_MATKEY_GLTF_ALPHACUTOFF, cutoff);
    if (mode == aiString("MASK")) return cutoff;
    return mode == aiString("BLEND") ? 0.5f : -1.f;
  }
  float opacity = 1.f;
  material.Get(AI_MATKEY_OPACITY, opacity);
  const bool transparent = opacity < 1.f || material.GetTextureCount(aiTextureType_OPACITY) > 0;
  return transparent ? 0.5f : -1.f;
}

Material convert_material(const aiMaterial& source, MeshFormat format, const TextureSource& textures) {
  Material material;
  aiString name;
  if (source.Get(AI_MATKEY_NAME, name) == aiReturn_SUCCESS) material.name = name.C_Str();
  const std::string reference = texture_reference(source, format);
  material.emissive = is_emissive(emitted_color(source, format));
  material.texture = textures.find(reference);
  material.texture_missing = !reference.empty() && material.texture == kNone;
  if (material.texture_missing) {
    material.base_color = {kNeutral, kNeutral, kNeutral, 1.f};
  } else if (is_gltf(format)) {
    material.base_color = gltf_color(source);
  } else if (material.texture == kNone) {
    material.base_color = diffuse_color(source);
  }
  if (material.texture != kNone) material.alpha_cutoff = alpha_cutoff(source, format);
  return material;
}

}  // namespace

void mark_untextured(std::span<const std::size_t> materials, Scene& scene) {
  for (const std::size_t index : materials) {
    Material& material = scene.materials.at(index);
    material.texture_missing = true;
    material.base_color = {kNeutral, kNeutral, kNeutral, 1.f};
  }
}

void convert_materials(const aiScene& file, const FileContext& context, Scene& scene) {
  std::vector<std::string> references;
  for (unsigned i = 0; i < file.mNumMaterials; ++i) {
    std::string reference = texture_reference(*file.mMaterials[i], context.format);
    if (!reference.empty() && std::ranges::find(references, reference) == references.end()) {
      references.push_back(std::move(reference));
    }
  }
  TextureSource textures(file, context.path, context.options);
  textures.load(references, scene);
  for (unsigned i = 0; i < file.mNumMaterials; ++i) {
    scene.materials.push_back(convert_material(*file.mMaterials[i], context.format, textures));
  }
}

}  // namespace wiw::scene
