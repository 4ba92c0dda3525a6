// SPDX-License-Identifier: Apache-2.0
#include "wiw/scene/import/gltf_materials.hpp"

#include <algorithm>
#include <cmath>
#include <map>

#include "wiw/core/error.hpp"
#include "wiw/scene/import/texture_source.hpp"

namespace wiw::scene {
namespace {

/// Factors are linear light; the scene multiplies display-encoded values (a pure power law).
float encoded(float linear) { return std::pow(std::clamp(linear, 0.f, 1.f), 1.f / 2.2f); }

template <std::size_t size>
std::array<float, size> numbers_or(const Json& list, float otherwise) {
  std::array<float, size> numbers;
  const Json::Array& items = list.items();
  for (std::size_t i = 0; i < size; ++i) {
    const auto number = i < items.size() ? items[i].number() : std::nullopt;
    numbers[i] = static_cast<float>(number.value_or(otherwise));
  }
  return numbers;
}

bool is_positive(float channel) { return channel > 0; }

/// What a material's surface is made of, in either of glTF's two ways to say it.
struct GltfSurface {
  explicit GltfSurface(const Json& material)
      : gloss(material["extensions"]["KHR_materials_pbrSpecularGlossiness"]),
        metal(material["pbrMetallicRoughness"]),
        base(numbers_or<4>(gloss.is_null() ? metal["baseColorFactor"] : gloss["diffuseFactor"], 1)),
        light(numbers_or<3>(material["emissiveFactor"], 0)) {
    const Json& strength = material["extensions"]["KHR_materials_emissive_strength"]["emissiveStrength"];
    for (float& channel : light) channel *= static_cast<float>(strength.number().value_or(1));
  }

  [[nodiscard]] const Json& base_texture() const {
    return gloss.is_null() ? metal["baseColorTexture"] : gloss["diffuseTexture"];
  }
  [[nodiscard]] bool is_lit() const { return std::ranges::any_of(light, is_positive); }
  [[nodiscard]] bool is_emissive_only() const {
    return std::ranges::none_of(std::span(base).first(3), is_positive) && is_lit();
  }

  const Json& gloss;
  const Json& metal;
  std::array<float, 4> base;
  std::array<float, 3> light;
};

/// The texture of the base colour; that of the light where there is none, or where the base colour is black.
const Json& drawn_texture(const Json& material) {
  const GltfSurface surface(material);
  const Json& base = surface.base_texture();
  const bool shows_light = surface.is_emissive_only() || (base.is_null() && surface.is_lit());
  return shows_light ? material["emissiveTexture"] : base;
}

std::string image_name(std::size_t index) { return "image " + std::to_string(index); }

/// Textures of a document by index: which image, and how it is sampled.
class GltfTextures {
 public:
  GltfTextures(const Json& document, GltfData& data, const std::filesystem::path& path, const ImportOptions& options)
      : document_(document), data_(data), source_(path, options) {}

  /// Decodes the images that materials show.
  void load(Scene& scene) {
    std::map<std::string, ImageReference> images;
    for (const Json& material : document_["materials"].items()) {
      const auto image = image_of(drawn_texture(material));
      if (!image) continue;
      ImageReference reference = image_reference(*image);
      names_[*image] = reference.name;
      images.try_emplace(reference.name, reference);
    }
    std::vector<ImageReference> references;
    references.reserve(images.size());
    for (auto& [name, reference] : images) references.push_back(std::move(reference));
    source_.load(references, scene);
  }

  std::int32_t find(const Json& info, Scene& scene) {
    const auto image = image_of(info);
    return image ? source_.find(names_.at(*image), sampling_of(info), scene) : kNone;
  }

 private:
  [[nodiscard]] const Json& texture_of(const Json& info) const {
    static const Json none;
    const Json::Array& textures = document_["textures"].items();
    const auto index = index_of(info, "index", textures.size());
    return index ? textures[*index] : none;
  }

  /// Images that every program reads come before those of extensions.
  [[nodiscard]] std::optional<std::size_t> image_of(const Json& info) const {
    const Json& texture = texture_of(info);
    const std::size_t count = document_["images"].items().size();
    if (const auto image = index_of(texture, "source", count)) return image;
    for (const char* extension : {"EXT_texture_webp", "KHR_texture_basisu", "GOOGLE_texture_basis"}) {
      if (const auto image = index_of(texture["extensions"][extension], "source", count)) return image;
    }
    return std::nullopt;
  }

  ImageReference image_reference(std::size_t index) {
    const Json& image = document_["images"].items()[index];
    const std::size_t views = document_["bufferViews"].items().size();
    if (const auto view = index_of(image, "bufferView", views)) return {image_name(index), data_.view(*view)};
    if (auto bytes = decode_data_uri(image["uri"].text())) {
      const auto& kept = inline_images_.emplace(index, *std::move(bytes)).first->second;
      return {image_name(index), kept};
    }
    const std::string uri(image["uri"].text());
    return {uri.empty() ? image_name(index) : uri, std::nullopt};
  }

  [[nodiscard]] Sampling sampling_of(const Json& info) const {
    const Json::Array& samplers = document_["samplers"].items();
    const auto index = index_of(texture_of(info), "sampler", samplers.size());
    if (!index) return {};
    const Json& sampler = samplers[*index];
    const auto wrap = [&](const char* axis) {
      const auto mode = sampler[axis].whole();
      return mode == 33071U ? Wrap::kClamp : (mode == 33648U ? Wrap::kMirror : Wrap::kRepeat);
    };
    return {wrap("wrapS"), wrap("wrapT"), sampler["magFilter"].whole() == 9728U};
  }

  const Json& document_;
  GltfData& data_;
  TextureSource source_;
  std::map<std::size_t, std::string> names_;  // of images, as `source_` knows them
  std::map<std::size_t, std::vector<std::uint8_t>> inline_images_;
};

/// Texture alpha counts only where the material says that it is transparent. Blending is drawn as a cut-out at one
/// half.
float alpha_cutoff(const Json& material) {
  const std::string_view mode = material["alphaMode"].text();
  if (mode == "MASK") return static_cast<float>(material["alphaCutoff"].number().value_or(0.5));
  return mode == "BLEND" ? 0.5f : -1.f;
}

Material convert_material(const Json& source, GltfTextures& textures, Scene& scene) {
  const GltfSurface surface(source);
  const Json& texture = drawn_texture(source);
  const bool is_light = surface.is_emissive_only();
  Material material;
  material.name = source["name"].text();
  material.emissive = is_light || !source["extensions"]["KHR_materials_unlit"].is_null();
  material.texture = textures.find(texture, scene);
  material.texture_missing = !texture.is_null() && material.texture == kNone;
  if (material.texture_missing) {
    material.base_color = {kNeutralGrey, kNeutralGrey, kNeutralGrey, 1.f};
    return material;
  }
  const std::span<const float> color = is_light ? std::span<const float>(surface.light) : surface.base;
  material.base_color = {encoded(color[0]), encoded(color[1]), encoded(color[2]),
                         std::clamp(surface.base[3], 0.f, 1.f)};
  if (material.texture != kNone) material.alpha_cutoff = alpha_cutoff(source);
  return material;
}

}  // namespace

void TexturePlacement::apply(float* uv) const {
  const float u = scale[0] * uv[0];
  const float v = scale[1] * uv[1];
  uv[0] = offset[0] + std::cos(rotation) * u + std::sin(rotation) * v;
  uv[1] = offset[1] - std::sin(rotation) * u + std::cos(rotation) * v;
}

std::optional<TexturePlacement> texture_placement(const Json& material) {
  const Json& texture = drawn_texture(material);
  if (texture.is_null()) return std::nullopt;
  const Json& transform = texture["extensions"]["KHR_texture_transform"];
  const Json& set = transform["texCoord"].is_null() ? texture["texCoord"] : transform["texCoord"];
  TexturePlacement placement;
  placement.set = set.whole().value_or(0);
  placement.offset = numbers_or<2>(transform["offset"], 0);
  placement.scale = numbers_or<2>(transform["scale"], 1);
  placement.rotation = static_cast<float>(transform["rotation"].number().value_or(0));
  return placement;
}

void convert_gltf_materials(const Json& document, GltfData& data, const std::filesystem::path& path,
                            const ImportOptions& options, Scene& scene) {
  GltfTextures textures(document, data, path, options);
  textures.load(scene);
  for (const Json& material : document["materials"].items()) {
    scene.materials.push_back(convert_material(material, textures, scene));
  }
}

}  // namespace wiw::scene
