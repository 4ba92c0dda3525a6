// SPDX-License-Identifier: Apache-2.0
#include "wiw/apartment/palette.hpp"

#include <cmath>
#include <set>

#include "wiw/apartment/random.hpp"
#include "wiw/core/error.hpp"

namespace wiw::apartment {

namespace {

/// Nearest value of the form step * (3 k + split).
float on_raster(float value, float step, Split split) {
  const float phase = static_cast<float>(split) * step;
  return phase + 3.f * step * std::round((value - phase) / (3.f * step));
}

/// Paint between chalky white and strong colour.
Rgb wall_paint(Split split, float hue, Rng& rng) {
  const double mood = rng.uniform();
  if (mood < 0.25) return swatch(split, range(rng, 0.93f, 0.96f), range(rng, 0.012f, 0.03f), hue);
  if (mood < 0.75) return swatch(split, range(rng, 0.85f, 0.92f), range(rng, 0.04f, 0.075f), hue);
  return swatch(split, range(rng, 0.70f, 0.80f), range(rng, 0.07f, 0.11f), hue);
}

Rgb wood_tone(Split split, Rng& rng) {
  const double kind = rng.uniform();
  if (kind < 0.3) return swatch(split, range(rng, 0.78f, 0.86f), 0.075f, range(rng, 65.f, 80.f));  // birch, pine
  if (kind < 0.6) return swatch(split, range(rng, 0.66f, 0.75f), 0.09f, range(rng, 58.f, 75.f));   // oak
  if (kind < 0.8) return swatch(split, range(rng, 0.44f, 0.55f), 0.075f, range(rng, 45.f, 62.f));  // walnut, cherry
  if (kind < 0.9) return swatch(split, range(rng, 0.34f, 0.40f), 0.03f, range(rng, 40.f, 60.f));   // wenge
  return swatch(split, range(rng, 0.92f, 0.95f), 0.01f, range(rng, 60.f, 100.f));                  // lacquered white
}

std::vector<Pattern> floor_choices(RoomType type) {
  using enum Pattern;
  if (is_wet(type)) return {kTiles, kHexagons, kChecker, kMarble, kTerrazzo, kTiles};
  switch (type) {
    case RoomType::kKitchen: return {kTiles, kChecker, kHexagons, kTerrazzo, kPlanks};
    case RoomType::kBedroom:
    case RoomType::kKids: return {kPlanks, kCarpet, kBasketParquet, kHerringbone, kCarpet};
    case RoomType::kCorridor:
    case RoomType::kHall: return {kPlanks, kTiles, kHerringbone, kChecker, kTerrazzo};
    default: return {kPlanks, kHerringbone, kBasketParquet, kConcrete, kCarpet};
  }
}

bool is_wooden(Pattern pattern) {
  return pattern == Pattern::kPlanks || pattern == Pattern::kHerringbone || pattern == Pattern::kBasketParquet;
}

void choose_floor(RoomLook& look, Split split, RoomType type, std::set<Pattern>& used, Rng& rng) {
  std::vector<Pattern> choices = floor_choices(type);
  shuffle(rng, choices);
  const auto fresh = std::find_if(choices.begin(), choices.end(), [&](Pattern p) { return !used.contains(p); });
  look.floor = fresh == choices.end() ? choices.front() : *fresh;
  used.insert(look.floor);
  const float hue = range(rng, 0.f, 360.f);
  if (is_wooden(look.floor)) {
    look.floor_color = swatch(split, range(rng, 0.5f, 0.84f), range(rng, 0.06f, 0.09f), range(rng, 50.f, 76.f));
  } else if (look.floor == Pattern::kCarpet) {
    look.floor_color = swatch(split, range(rng, 0.5f, 0.78f), range(rng, 0.03f, 0.08f), hue);
  } else if (look.floor == Pattern::kConcrete) {
    look.floor_color = swatch(split, range(rng, 0.66f, 0.78f), 0.012f, hue);
  } else {
    look.floor_color = swatch(split, range(rng, 0.72f, 0.92f), range(rng, 0.01f, 0.05f), hue);
  }
  look.floor_second = swatch(split, range(rng, 0.36f, 0.6f), range(rng, 0.02f, 0.08f), hue + range(rng, -40.f, 40.f));
}

WallStyle wall_style(RoomType type, Rng& rng) {
  using enum WallStyle;
  if (type == RoomType::kBathroom) return rng.chance(0.6) ? kHalfTiles : kFullTiles;
  if (type == RoomType::kLaundry) return rng.chance(0.5) ? kHalfTiles : kPaint;
  if (type == RoomType::kKitchen) return rng.chance(0.6) ? kPaint : kAccentWall;
  if (is_passage(type)) return rng.chance(0.35) ? kWainscot : kPaint;
  constexpr std::array<WallStyle, 8> kDry{kPaint,     kAccentWall,      kAccentWall,      kAccentBrick,
                                          kWallpaper, kAccentWallpaper, kAccentWallpaper, kWainscot};
  return pick(rng, kDry);
}

RoomLook room_look(Split split, RoomType type, float hue, std::set<Pattern>& floors, Rng& rng) {
  RoomLook look;
  look.walls = wall_style(type, rng);
  look.wall = wall_paint(split, hue, rng);
  const float shift = rng.chance(0.5) ? range(rng, -25.f, 25.f) : range(rng, 140.f, 220.f);
  look.accent = swatch(split, range(rng, 0.42f, 0.66f), range(rng, 0.06f, 0.12f), hue + shift);
  if (look.walls == WallStyle::kAccentBrick)
    look.accent = swatch(split, range(rng, 0.5f, 0.72f), range(rng, 0.05f, 0.11f), range(rng, 32.f, 60.f));
  if (type == RoomType::kBathroom || type == RoomType::kLaundry)
    look.accent = swatch(split, range(rng, 0.6f, 0.9f), range(rng, 0.03f, 0.09f), hue + shift);
  constexpr std::array<Pattern, 5> kPapers{Pattern::kStripes, Pattern::kDamask, Pattern::kTrellis, Pattern::kDots,
                                           Pattern::kLeaves};
  look.paper = pick(rng, kPapers);
  look.split_height = look.walls == WallStyle::kHalfTiles  ? snap(range(rng, 1.2f, 1.6f))
                      : look.walls == WallStyle::kWainscot ? snap(range(rng, 0.8f, 1.05f))
                                                           : 0.f;
  look.accent_side = static_cast<int>(rng.below(4));
  choose_floor(look, split, type, floors, rng);
  look.ceiling = swatch(split, 0.965f, 0.006f, range(rng, 60.f, 110.f));
  look.wood = wood_tone(split, rng);
  const float fabric_hue = range(rng, 0.f, 360.f);
  look.fabrics[0] = swatch(split, range(rng, 0.4f, 0.75f), range(rng, 0.06f, 0.14f), fabric_hue);
  look.fabrics[1] =
      swatch(split, range(rng, 0.5f, 0.85f), range(rng, 0.03f, 0.12f), fabric_hue + range(rng, 90.f, 270.f));
  look.fabrics[2] =
      swatch(split, range(rng, 0.8f, 0.94f), range(rng, 0.01f, 0.04f), fabric_hue + range(rng, -60.f, 60.f));
  return look;
}

}  // namespace

Rgb swatch(Split split, float lightness, float chroma, float hue) {
  return oklch(on_raster(lightness, 0.006f, split), chroma, on_raster(hue, 5.f, split));
}

Palette make_palette(std::uint64_t seed, Split split, const FloorPlan& plan) {
  Palette palette;
  Rng shared = stream(seed, Stream::kPalette, static_cast<std::uint64_t>(split));
  const float first_hue = range(shared, 0.f, 360.f);
  const Rgb trim = swatch(split, range(shared, 0.9f, 0.96f), 0.012f, range(shared, 60.f, 110.f));
  palette.door = shared.chance(0.5) ? trim : wood_tone(split, shared);
  std::set<Pattern> floors;
  for (std::size_t i = 0; i < plan.rooms.size(); ++i) {
    Rng rng = stream(seed, Stream::kPalette, static_cast<std::uint64_t>(split), i + 1);
    // Steps of the golden angle keep the hues of any number of rooms apart.
    const float hue = first_hue + 137.508f * static_cast<float>(i) + range(rng, -12.f, 12.f);
    palette.rooms.push_back(room_look(split, plan.rooms[i].type, hue, floors, rng));
    palette.rooms.back().trim = trim;
  }
  return palette;
}

namespace {

/// Middle of a colour's name: lightness, chroma and hue.
struct ColorRange {
  std::string name;
  Eigen::Vector2f lightness, chroma, hue;
};

const std::vector<ColorRange>& named_colors() {
  static const std::vector<ColorRange> kColors{{"beige", {0.8f, 0.87f}, {0.045f, 0.06f}, {75.f, 95.f}},
                                               {"black", {0.2f, 0.26f}, {0.005f, 0.012f}, {0.f, 360.f}},
                                               {"blue", {0.45f, 0.6f}, {0.1f, 0.15f}, {240.f, 270.f}},
                                               {"brown", {0.4f, 0.5f}, {0.06f, 0.09f}, {48.f, 72.f}},
                                               {"green", {0.5f, 0.66f}, {0.1f, 0.15f}, {130.f, 155.f}},
                                               {"grey", {0.55f, 0.68f}, {0.004f, 0.012f}, {0.f, 360.f}},
                                               {"orange", {0.7f, 0.76f}, {0.14f, 0.17f}, {52.f, 68.f}},
                                               {"pink", {0.72f, 0.82f}, {0.09f, 0.13f}, {345.f, 363.f}},
                                               {"purple", {0.45f, 0.6f}, {0.1f, 0.15f}, {295.f, 317.f}},
                                               {"red", {0.48f, 0.56f}, {0.15f, 0.19f}, {17.f, 29.f}},
                                               {"turquoise", {0.64f, 0.78f}, {0.08f, 0.11f}, {180.f, 205.f}},
                                               {"white", {0.94f, 0.97f}, {0.004f, 0.012f}, {60.f, 110.f}},
                                               {"yellow", {0.83f, 0.89f}, {0.13f, 0.16f}, {90.f, 106.f}}};
  return kColors;
}

}  // namespace

const std::vector<std::string>& color_names() {
  static const std::vector<std::string> kNames = [] {
    std::vector<std::string> names;
    for (const ColorRange& color : named_colors()) names.push_back(color.name);
    return names;
  }();
  return kNames;
}

Rgb draw_color(const std::string& name, Split split, Rng& rng) {
  for (const ColorRange& color : named_colors()) {
    for (int attempt = 0; color.name == name && attempt < 1000; ++attempt) {
      const float lightness = range(rng, color.lightness.x(), color.lightness.y()),
                  chroma = range(rng, color.chroma.x(), color.chroma.y());
      // The raster may move a colour over the border to another name.
      const Rgb drawn = swatch(split, lightness, chroma, range(rng, color.hue.x(), color.hue.y()));
      if (color_name(drawn) == name) return drawn;
    }
  }
  throw ArgumentError("'" + name + "' is no colour's name");
}

std::vector<Rgb> Palette::colors() const {
  std::vector<Rgb> all{door};
  for (const RoomLook& look : rooms) {
    all.insert(all.end(),
               {look.wall, look.accent, look.floor_color, look.floor_second, look.ceiling, look.trim, look.wood});
    all.insert(all.end(), look.fabrics.begin(), look.fabrics.end());
  }
  return all;
}

}  // namespace wiw::apartment
