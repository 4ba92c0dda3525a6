// SPDX-License-Identifier: Apache-2.0
#include "wiw/apartment/color.hpp"

#include <array>
#include <cmath>
#include <cstdio>
#include <utility>

namespace wiw::apartment {

namespace {

struct Lch {
  float lightness;
  float chroma;
  float hue;  // degrees in [0, 360)
};

Lch to_oklch(const Rgb& color) {
  const Rgb linear = to_linear(color);
  const float l = std::cbrt(0.4122214708f * linear.x() + 0.5363325363f * linear.y() + 0.0514459929f * linear.z());
  const float m = std::cbrt(0.2119034982f * linear.x() + 0.6806995451f * linear.y() + 0.1073969566f * linear.z());
  const float s = std::cbrt(0.0883024619f * linear.x() + 0.2817188376f * linear.y() + 0.6299787005f * linear.z());
  const float a = 1.9779984951f * l - 2.4285922050f * m + 0.4505937099f * s;
  const float b = 0.0259040371f * l + 0.7827717662f * m - 0.8086757660f * s;
  const float hue = std::atan2(b, a) * 57.29577951f;
  return {0.2104542553f * l + 0.7936177850f * m - 0.0040720468f * s, std::hypot(a, b), hue < 0.f ? hue + 360.f : hue};
}

}  // namespace

Rgb to_linear(const Rgb& encoded) { return encoded.array().max(0.f).pow(kGamma); }
Rgb to_encoded(const Rgb& linear) { return linear.array().max(0.f).pow(1.f / kGamma); }

Rgb oklch(float lightness, float chroma, float hue) {
  const float a = chroma * std::cos(hue / 57.29577951f);
  const float b = chroma * std::sin(hue / 57.29577951f);
  const auto cube = [](float x) { return x * x * x; };
  const float l = cube(lightness + 0.3963377774f * a + 0.2158037573f * b);
  const float m = cube(lightness - 0.1055613458f * a - 0.0638541728f * b);
  const float s = cube(lightness - 0.0894841775f * a - 1.2914855480f * b);
  const Rgb linear(4.0767416621f * l - 3.3077115913f * m + 0.2309699292f * s,
                   -1.2684380046f * l + 2.6097574011f * m - 0.3413193965f * s,
                   -0.0041960863f * l - 0.7034186147f * m + 1.7076147010f * s);
  return to_encoded(linear.array().min(1.f).matrix());
}

std::string color_name(const Rgb& color) {
  const Lch c = to_oklch(color);
  if (c.chroma < 0.035f) return c.lightness > 0.88f ? "white" : c.lightness < 0.33f ? "black" : "grey";
  const bool warm = c.hue > 30.f && c.hue < 105.f;
  if (warm && c.lightness < 0.68f && c.chroma < 0.13f) return "brown";
  if (warm && c.chroma < 0.075f) return "beige";
  constexpr std::array<std::pair<float, const char*>, 9> kHues{{{12.f, "pink"},
                                                                {40.f, "red"},
                                                                {75.f, "orange"},
                                                                {115.f, "yellow"},
                                                                {165.f, "green"},
                                                                {215.f, "turquoise"},
                                                                {280.f, "blue"},
                                                                {325.f, "purple"},
                                                                {360.f, "pink"}}};
  for (const auto& [end, name] : kHues) {
    if (c.hue < end) return name;
  }
  return "pink";
}

std::string hex_code(const Rgb& color) {
  std::array<char, 8> text{};
  const auto byte = [](float value) { return static_cast<unsigned>(std::lround(255.f * value)) & 0xFFu; };
  std::snprintf(text.data(), text.size(), "#%02x%02x%02x", byte(color.x()), byte(color.y()), byte(color.z()));
  return text.data();
}

}  // namespace wiw::apartment
