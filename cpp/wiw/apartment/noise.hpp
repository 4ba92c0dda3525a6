// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cmath>
#include <cstdint>

namespace wiw::apartment {

/// Integer hash after "lowbias32" (C. Wellons, hash-prospector), for lattice noise that must be fast, not strong.
inline std::uint32_t hash(std::uint32_t x) {
  x ^= x >> 16;
  x *= 0x7feb352du;
  x ^= x >> 15;
  x *= 0x846ca68bu;
  return x ^ (x >> 16);
}
inline std::uint32_t hash(int x, int y, std::uint32_t seed) {
  return hash(static_cast<std::uint32_t>(x) * 0x9E3779B9u ^ hash(static_cast<std::uint32_t>(y) + seed * 0x85EBCA6Bu));
}
/// Uniform in [0, 1).
inline float hash_unit(int x, int y, std::uint32_t seed) {
  return static_cast<float>(hash(x, y, seed) >> 8) * 0x1p-24f;
}

inline int wrap(int value, int period) {
  const int rest = value % period;
  return rest < 0 ? rest + period : rest;
}

inline float smooth(float low, float high, float x) {
  const float t = std::fmin(1.f, std::fmax(0.f, (x - low) / (high - low)));
  return t * t * (3.f - 2.f * t);
}

/// Value noise in [0, 1] that repeats every `period_x` and `period_y` lattice cells.
inline float noise(float x, float y, int period_x, int period_y, std::uint32_t seed) {
  const float fx = std::floor(x), fy = std::floor(y);
  const int x0 = wrap(static_cast<int>(fx), period_x), y0 = wrap(static_cast<int>(fy), period_y);
  const int x1 = wrap(x0 + 1, period_x), y1 = wrap(y0 + 1, period_y);
  const float tx = x - fx, ty = y - fy;
  const float sx = tx * tx * (3.f - 2.f * tx), sy = ty * ty * (3.f - 2.f * ty);
  const float a = hash_unit(x0, y0, seed) * (1.f - sx) + hash_unit(x1, y0, seed) * sx;
  const float b = hash_unit(x0, y1, seed) * (1.f - sx) + hash_unit(x1, y1, seed) * sx;
  return a * (1.f - sy) + b * sy;
}

/// Octaves of noise over the unit square, tileable; `x` and `y` in [0, 1), `cells_*` lattice cells in the first octave.
inline float fractal(float x, float y, int cells_x, int cells_y, int octaves, std::uint32_t seed) {
  float sum = 0.f, total = 0.f, weight = 1.f;
  for (int i = 0; i < octaves; ++i) {
    sum += weight * noise(x * static_cast<float>(cells_x), y * static_cast<float>(cells_y), cells_x, cells_y,
                          seed + static_cast<std::uint32_t>(i));
    total += weight;
    weight *= 0.5f;
    cells_x *= 2;
    cells_y *= 2;
  }
  return sum / total;
}

}  // namespace wiw::apartment
