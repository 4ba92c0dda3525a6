// SPDX-License-Identifier: Apache-2.0
#include "wiw/apartment/materials.hpp"

#include <algorithm>

#include "wiw/apartment/random.hpp"

namespace wiw::apartment {

namespace {

struct NeutralStyle {
  const char* kind;
  Vec2 metres;
  Size size;
};

NeutralStyle neutral_style(Pattern pattern) {
  switch (pattern) {
    case Pattern::kPlaster: return {"plaster", {2.f, 2.f}, {256, 256}};
    case Pattern::kGrain: return {"wood", {1.2f, 0.6f}, {256, 256}};
    case Pattern::kWeave: return {"fabric", {0.3f, 0.3f}, {256, 256}};
    case Pattern::kLeather: return {"leather", {0.5f, 0.5f}, {256, 256}};
    case Pattern::kBrushed: return {"metal", {1.f, 0.5f}, {128, 128}};
    case Pattern::kPlanks: return {"wood planks", {2.4f, 1.2f}, {512, 512}};
    case Pattern::kHerringbone:
    case Pattern::kBasketParquet: return {"wood parquet", {1.6f, 1.6f}, {512, 512}};
    case Pattern::kCarpet: return {"carpet", {1.f, 1.f}, {256, 256}};
    case Pattern::kConcrete: return {"concrete", {3.f, 3.f}, {512, 512}};
    case Pattern::kWicker: return {"wicker", {0.32f, 0.32f}, {128, 128}};
    default: return {"plain", {1.f, 1.f}, {64, 64}};
  }
}

}  // namespace

MaterialId MaterialTable::add(Finish finish) {
  for (MaterialId id = 0; id < finishes_.size(); ++id) {
    const Finish& f = finishes_[id];
    if (f.kind == finish.kind && f.color == finish.color && f.texture == finish.texture && f.metres == finish.metres &&
        f.emissive == finish.emissive) {
      return id;
    }
  }
  finishes_.push_back(std::move(finish));
  return static_cast<MaterialId>(finishes_.size() - 1);
}

std::int32_t MaterialTable::request(TextureRequest request) {
  for (std::size_t i = 0; i < requests_.size(); ++i) {
    if (requests_[i] == request) return static_cast<std::int32_t>(i);
  }
  requests_.push_back(std::move(request));
  return static_cast<std::int32_t>(requests_.size() - 1);
}

MaterialId MaterialTable::tinted(Pattern pattern, const Rgb& color) {
  const NeutralStyle style = neutral_style(pattern);
  const std::uint32_t variant = stream(seed_, Stream::kTextures, static_cast<std::uint64_t>(pattern))() >> 8;
  return add({style.kind, color, request({pattern, {}, variant, style.size}), style.metres});
}

MaterialId MaterialTable::covering(Pattern pattern, std::vector<Rgb> colors, const Vec2& metres,
                                   const std::string& kind, std::uint32_t variant) {
  return add({kind, Rgb::Ones(), request({pattern, std::move(colors), variant, {256, 256}}), metres});
}

MaterialId MaterialTable::image(Pattern pattern, std::vector<Rgb> colors, std::uint32_t variant, Size size,
                                const std::string& kind, bool emissive) {
  return add({kind, Rgb::Ones(), request({pattern, std::move(colors), variant, size}), Vec2::Ones(), emissive});
}

bool MaterialTable::shows(MaterialId id, const Rgb& color) const {
  const Finish& finish = finishes_[id];
  if (finish.color == color) return true;
  if (finish.texture == scene::kNone) return false;
  const std::vector<Rgb>& colors = requests_[static_cast<std::size_t>(finish.texture)].colors;
  return std::find(colors.begin(), colors.end(), color) != colors.end();
}

MaterialId MaterialTable::repaint(MaterialId id, const Rgb& from, const Rgb& to) {
  Finish finish = finishes_[id];
  if (finish.color == from) finish.color = to;
  if (finish.texture != scene::kNone) {
    TextureRequest drawn = requests_[static_cast<std::size_t>(finish.texture)];
    std::replace(drawn.colors.begin(), drawn.colors.end(), from, to);
    finish.texture = request(std::move(drawn));
  }
  return add(std::move(finish));
}

std::vector<scene::Texture> MaterialTable::draw_textures(ThreadPool& pool) const {
  std::vector<scene::Texture> textures(requests_.size());
  pool.parallel_for(requests_.size(),
                    [&](std::size_t i) { textures[i] = make_texture(requests_[i], "texture " + std::to_string(i)); });
  return textures;
}

std::vector<scene::Material> MaterialTable::to_materials() const {
  std::vector<scene::Material> materials;
  for (const Finish& finish : finishes_) {
    scene::Material material;
    material.name = color_name(finish.color) + " " + finish.kind;
    material.base_color = {finish.color.x(), finish.color.y(), finish.color.z(), 1.f};
    material.texture = finish.texture;
    material.emissive = finish.emissive;
    materials.push_back(std::move(material));
  }
  return materials;
}

}  // namespace wiw::apartment
