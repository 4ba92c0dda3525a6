// SPDX-License-Identifier: Apache-2.0
#pragma once

/// Arithmetic on lanes and texture sampling. Included after a simd_*.hpp.

namespace wiw::render::cpu {
namespace {

struct RgbLanes {
  Floats r, g, b;
};

inline RgbLanes multiply(const RgbLanes& a, const RgbLanes& b) { return {a.r * b.r, a.g * b.g, a.b * b.b}; }

/// Into [0, 1]; not-a-number becomes 0, so that no texture coordinate can leave its texture.
inline Floats saturate(Floats x) {
  const Floats positive = x > 0.f ? x : Floats{};
  return positive < 1.f ? positive : Floats{} + 1.f;
}

/// log2 for x > 0 from the exponent and m = mantissa - 1 in [0, 1): log2(1 + m) ~ m (1 + (1 - m) q(m)), q fitted by
/// least squares; exact at both ends, error below 2.2e-5.
inline Floats log2_of(Floats x) {
  const Ints bits = reinterpret_cast<Ints>(x);
  const Floats exponent = __builtin_convertvector((bits >> 23) - 127, Floats);
  const Floats m = reinterpret_cast<Floats>((bits & 0x7FFFFF) | 0x3F800000) - 1.f;
  const Floats q = ((-0.04400469f * m + 0.14631434f) * m - 0.26602988f) * m + 0.4417403f;
  return exponent + m * (1.f + (1.f - m) * q);
}

/// The three colour bytes of RGBA words as floats in [0, 255].
inline RgbLanes unpack(Ints texel) {
  return {__builtin_convertvector(texel & 255, Floats), __builtin_convertvector((texel >> 8) & 255, Floats),
          __builtin_convertvector((texel >> 16) & 255, Floats)};
}

inline RgbLanes mix(const RgbLanes& a, const RgbLanes& b, Floats weight) {
  return {a.r + weight * (b.r - a.r), a.g + weight * (b.g - a.g), a.b + weight * (b.b - a.b)};
}

/// Bilinear colour in [0, 255] at (u, v) in [0, 1] of each lane's level.
inline RgbLanes sample_level(const SampledTexture& texture, Floats u, Floats v, Floats width, Floats height,
                             Ints offset) {
  const Floats x = u * width + 0.5f;  // texel centres at half integers, plus the border of one texel
  const Floats y = v * height + 0.5f;
  const Ints column = __builtin_convertvector(x, Ints);
  const Ints row = __builtin_convertvector(y, Ints);
  const Floats right = x - __builtin_convertvector(column, Floats);
  const Floats below = y - __builtin_convertvector(row, Floats);
  const Ints stride = __builtin_convertvector(width, Ints) + 2;
  const Ints index = offset + row * stride + column;
  Ints top_left, top_right, bottom_left, bottom_right;
  load_pairs(texture.texels, index, top_left, top_right);
  load_pairs(texture.texels, index + stride, bottom_left, bottom_right);
  return mix(mix(unpack(top_left), unpack(top_right), right), mix(unpack(bottom_left), unpack(bottom_right), right),
             below);
}

inline Floats wrap(const SampledTexture& texture, Floats coordinate) {
  return saturate(texture.repeat ? coordinate - floor_of(coordinate) : coordinate);
}

inline RgbLanes normalised(const RgbLanes& bytes) {
  return {bytes.r * (1.f / 255.f), bytes.g * (1.f / 255.f), bytes.b * (1.f / 255.f)};
}

/// Level 0 alone.
inline RgbLanes sample_bilinear(const SampledTexture& texture, Floats u, Floats v) {
  return normalised(sample_level(texture, wrap(texture, u), wrap(texture, v), Floats{} + texture.width[0],
                                 Floats{} + texture.height[0], Ints{} + texture.offset[0]));
}

inline RgbLanes sample_trilinear(const SampledTexture& texture, Floats u, Floats v, Floats lod) {
  u = wrap(texture, u);
  v = wrap(texture, v);
  lod = lod > 0.f ? lod : Floats{};
  lod = lod < texture.last_level ? lod : Floats{} + texture.last_level;
  const Ints fine = __builtin_convertvector(lod, Ints);
  const Floats blend = lod - __builtin_convertvector(fine, Floats);
  RgbLanes color = sample_level(texture, u, v, look_up(texture.width, fine), look_up(texture.height, fine),
                                look_up(texture.offset, fine));
  if (mask_bits(blend > 0.f) != 0) {
    const Ints coarse = blend > 0.f ? fine + 1 : fine;
    color = mix(color,
                sample_level(texture, u, v, look_up(texture.width, coarse), look_up(texture.height, coarse),
                             look_up(texture.offset, coarse)),
                blend);
  }
  return normalised(color);
}

}  // namespace
}  // namespace wiw::render::cpu
