// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <string>
#include <vector>

#include "wiw/apartment/shape.hpp"
#include "wiw/apartment/textures.hpp"
#include "wiw/core/thread_pool.hpp"

namespace wiw::apartment {

/// What a surface is made of; textures are drawn once all surfaces are known.
struct Finish {
  std::string kind;  // "wood", "fabric", ...: the attribute "material"
  Rgb color = Rgb::Ones();
  std::int32_t texture = scene::kNone;  // index into the table's requests
  Vec2 metres = Vec2::Ones();           // extent of one image of the texture; (1, 1) for whole images
  bool emissive = false;
};

class MaterialTable {
 public:
  explicit MaterialTable(std::uint64_t seed) : seed_(seed) {}

  MaterialId plain(const std::string& kind, const Rgb& color) { return add({kind, color}); }
  MaterialId glow(const Rgb& color) { return add({"glass", color, scene::kNone, Vec2::Ones(), true}); }
  /// A neutral pattern in the given colour.
  MaterialId tinted(Pattern pattern, const Rgb& color);
  /// A pattern of several colours that repeats every `metres`.
  MaterialId covering(Pattern pattern, std::vector<Rgb> colors, const Vec2& metres, const std::string& kind,
                      std::uint32_t variant = 0);
  /// A whole image, e.g. a painting, a rug or a screen.
  MaterialId image(Pattern pattern, std::vector<Rgb> colors, std::uint32_t variant, Size size, const std::string& kind,
                   bool emissive = false);

  /// Whether the finish has the colour, itself or in its texture.
  [[nodiscard]] bool shows(MaterialId id, const Rgb& color) const;
  /// The same finish with one colour instead of another.
  MaterialId repaint(MaterialId id, const Rgb& from, const Rgb& to);

  [[nodiscard]] const Finish& finish(MaterialId id) const { return finishes_[id]; }
  [[nodiscard]] std::size_t size() const { return finishes_.size(); }
  /// Draws the textures requested so far.
  [[nodiscard]] std::vector<scene::Texture> draw_textures(ThreadPool& pool) const;
  [[nodiscard]] std::vector<scene::Material> to_materials() const;

 private:
  MaterialId add(Finish finish);
  std::int32_t request(TextureRequest request);

  std::uint64_t seed_;
  std::vector<Finish> finishes_;
  std::vector<TextureRequest> requests_;
};

}  // namespace wiw::apartment
