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

/// The middle of the texel that `x` lies in, counted with the border; at the far edge it is the last one's.
inline Floats texel_middle(Floats x, Floats size) {
  const Floats texel = __builtin_convertvector(__builtin_convertvector(x, Ints), Floats);
  return (texel < size - 1.f ? texel : size - 1.f) + 1.f;
}

/// Bilinear colour in [0, 255] at (u, v) in [0, 1] of each lane's level; in lanes `square`, that of the texel alone.
inline RgbLanes sample_level(const SampledTexture& texture, Floats u, Floats v, Floats width, Floats height,
                             Ints offset, Ints square = Ints{}) {
  Floats x = u * width + 0.5f;  // texel centres at half integers, plus the border of one texel
  Floats y = v * height + 0.5f;
  if (texture.nearest) {
    x = square ? texel_middle(u * width, width) : x;
    y = square ? texel_middle(v * height, height) : y;
  }
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

inline Floats wrap(Edge edge, Floats coordinate) {
  if (edge == Edge::kRepeat) coordinate -= floor_of(coordinate);
  if (edge == Edge::kMirror) {
    coordinate -= 2.f * floor_of(0.5f * coordinate);
    coordinate = coordinate > 1.f ? 2.f - coordinate : coordinate;
  }
  return saturate(coordinate);
}

inline RgbLanes normalised(const RgbLanes& bytes) {
  return {bytes.r * (1.f / 255.f), bytes.g * (1.f / 255.f), bytes.b * (1.f / 255.f)};
}

/// Level 0 alone.
inline RgbLanes sample_bilinear(const SampledTexture& texture, Floats u, Floats v) {
  return normalised(sample_level(texture, wrap(texture.edge_u, u), wrap(texture.edge_v, v), Floats{} + texture.width[0],
                                 Floats{} + texture.height[0], Ints{} + texture.offset[0]));
}

inline RgbLanes sample_trilinear(const SampledTexture& texture, Floats u, Floats v, Floats lod) {
  u = wrap(texture.edge_u, u);
  v = wrap(texture.edge_v, v);
  lod = lod > 0.f ? lod : Floats{};
  lod = lod < texture.last_level ? lod : Floats{} + texture.last_level;
  const Ints fine = __builtin_convertvector(lod, Ints);
  const Floats blend = lod - __builtin_convertvector(fine, Floats);
  RgbLanes color = sample_level(texture, u, v, look_up(texture.width, fine), look_up(texture.height, fine),
                                look_up(texture.offset, fine), lod <= 0.f);
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
