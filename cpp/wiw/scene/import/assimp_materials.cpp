// SPDX-License-Identifier: Apache-2.0
#include <assimp/scene.h>

#include <algorithm>
#include <array>

#include "wiw/scene/import/assimp_scene.hpp"
#include "wiw/scene/import/texture_source.hpp"

namespace wiw::scene {
namespace {

struct TextureUse {
  std::string image;
  Sampling sampling;
};

Wrap wrap_of(aiTextureMapMode mode) {
  switch (mode) {
    case aiTextureMapMode_Clamp:
    case aiTextureMapMode_Decal: return Wrap::kClamp;
    case aiTextureMapMode_Mirror: return Wrap::kMirror;
    default: return Wrap::kRepeat;
  }
}

TextureUse drawn_texture(const aiMaterial& material) {
  aiString path;
  std::array<aiTextureMapMode, 3> modes{aiTextureMapMode_Wrap, aiTextureMapMode_Wrap, aiTextureMapMode_Wrap};
  for (const aiTextureType type : {aiTextureType_BASE_COLOR, aiTextureType_DIFFUSE, aiTextureType_EMISSIVE}) {
    const aiReturn found = material.GetTexture(type, 0, &path, nullptr, nullptr, nullptr, nullptr, modes.data());
    if (found == aiReturn_SUCCESS && path.length > 0) return {path.C_Str(), {wrap_of(modes[0]), wrap_of(modes[1])}};
  }
  return {};
}

Eigen::Vector4f diffuse_color(const aiMaterial& material) {
  aiColor4D color(kNeutralGrey, kNeutralGrey, kNeutralGrey, 1);
  material.Get(AI_MATKEY_COLOR_DIFFUSE, color);
  return Eigen::Vector4f(color.r, color.g, color.b, 1.f).cwiseMax(0.f).cwiseMin(1.f);
}

/// Texture alpha counts only where the material says that it is transparent: many exporters leave junk in it.
float alpha_cutoff(const aiMaterial& material) {
  float opacity = 1.f;
  material.Get(AI_MATKEY_OPACITY, opacity);
  const bool transparent = opacity < 1.f || material.GetTextureCount(aiTextureType_OPACITY) > 0;
  return transparent ? 0.5f : -1.f;
}

Material convert_material(const aiMaterial& source, TextureSource& textures, Scene& scene) {
  Material material;
  aiString name;
  if (source.Get(AI_MATKEY_NAME, name) == aiReturn_SUCCESS) material.name = name.C_Str();
  const TextureUse texture = drawn_texture(source);
  material.texture = textures.find(texture.image, texture.sampling, scene);
  material.texture_missing = !texture.image.empty() && material.texture == kNone;
  if (material.texture_missing) {
    material.base_color = {kNeutralGrey, kNeutralGrey, kNeutralGrey, 1.f};
  } else if (material.texture == kNone) {
    material.base_color = diffuse_color(source);
  } else {
    material.alpha_cutoff = alpha_cutoff(source);
  }
  return material;
}

ImageReference image_reference(const aiScene& file, const std::string& name) {
  const aiTexture* texture = file.GetEmbeddedTexture(name.c_str());
  if (texture == nullptr || texture->mHeight > 0) return {name, std::nullopt};
  return {name, std::span(reinterpret_cast<const std::uint8_t*>(texture->pcData), texture->mWidth)};
}

}  // namespace

void convert_materials(const aiScene& file, const FileContext& context, Scene& scene) {
  std::vector<ImageReference> images;
  for (unsigned i = 0; i < file.mNumMaterials; ++i) {
    const std::string name = drawn_texture(*file.mMaterials[i]).image;
    const bool is_known = std::ranges::find(images, name, &ImageReference::name) != images.end();
    if (!name.empty() && !is_known) images.push_back(image_reference(file, name));
  }
  TextureSource textures(context.path, context.options);
  textures.load(images, scene);
  for (unsigned i = 0; i < file.mNumMaterials; ++i) {
    scene.materials.push_back(convert_material(*file.mMaterials[i], textures, scene));
  }
}

}  // namespace wiw::scene
