// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <array>
#include <cstdint>
#include <string>
#include <vector>

#include "wiw/apartment/apartment.hpp"
#include "wiw/apartment/color.hpp"
#include "wiw/apartment/floor_plan.hpp"
#include "wiw/apartment/textures.hpp"
#include "wiw/core/rng.hpp"

namespace wiw::apartment {

/// Colour near (lightness, chroma, hue) on the raster of one split: hues 15 degrees and lightnesses 0.018 apart,
/// interleaved with the rasters of the other splits, so that no two splits have a colour in common.
Rgb swatch(Split split, float lightness, float chroma, float hue);

/// Names that color_name gives.
const std::vector<std::string>& color_names();
/// A colour of that name on the split's raster; ArgumentError for an unknown name.
Rgb draw_color(const std::string& name, Split split, Rng& rng);

enum class WallStyle {
  kPaint,
  kAccentWall,
  kAccentBrick,
  kWallpaper,
  kAccentWallpaper,
  kWainscot,
  kHalfTiles,
  kFullTiles
};

/// Colours and coverings of one room.
struct RoomLook {
  WallStyle walls = WallStyle::kPaint;
  Rgb wall, accent;  // main and second wall colour
  Pattern paper = Pattern::kStripes;
  float split_height = 0.f;  // wainscot or tiles reach up to here
  int accent_side = 0;
  Pattern floor = Pattern::kPlanks;
  Rgb floor_color, floor_second;
  Rgb ceiling, trim;  // trim: skirting, door and window frames
  Rgb wood;           // furniture
  std::array<Rgb, 3> fabrics;
};

struct Palette {
  std::vector<RoomLook> rooms;
  Rgb door;
  [[nodiscard]] std::vector<Rgb> colors() const;
};

Palette make_palette(std::uint64_t seed, Split split, const FloorPlan& plan);

}  // namespace wiw::apartment
