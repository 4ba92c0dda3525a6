// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cmath>
#include <initializer_list>
#include <utility>
#include <vector>

#include "wiw/core/rng.hpp"

namespace wiw::apartment {

/// Streams of one apartment, so that a change in one stage leaves the others as they are.
enum class Stream : std::uint64_t { kLayout = 1, kOpenings, kPalette, kRooms, kFurniture, kObjects, kTextures, kLight };

/// Key of a stream within an apartment: each part is mixed into the key of those before it.
inline std::uint64_t stream_key(std::initializer_list<std::uint64_t> parts) {
  std::uint64_t key = kRootKey;
  for (const std::uint64_t part : parts) key = mix_key(key, part);
  return key;
}

inline Rng stream(std::uint64_t seed, Stream which, std::uint64_t a = 0, std::uint64_t b = 0) {
  return Rng(stream_key({0xA9A27, seed, static_cast<std::uint64_t>(which), a, b}));
}

inline float range(Rng& rng, float low, float high) { return static_cast<float>(rng.uniform(low, high)); }

template <class Container>
const auto& pick(Rng& rng, const Container& from) {
  return from[rng.below(static_cast<std::uint32_t>(from.size()))];
}

template <class T>
void shuffle(Rng& rng, std::vector<T>& values) {
  for (std::size_t i = values.size(); i > 1; --i)
    std::swap(values[i - 1], values[rng.below(static_cast<std::uint32_t>(i))]);
}

/// Plans use a 5 cm raster.
inline float snap(float metres) { return std::round(metres * 20.f) / 20.f; }

}  // namespace wiw::apartment
