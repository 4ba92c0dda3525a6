// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <array>
#include <cstdint>
#include <initializer_list>
#include <span>

namespace wiw {

/// Philox4x32-10 block function (Salmon et al., "Parallel random numbers: as easy as 1, 2, 3", SC 2011).
inline std::array<std::uint32_t, 4> philox4x32(std::array<std::uint32_t, 4> counter, std::array<std::uint32_t, 2> key) {
  for (int round = 0; round < 10; ++round) {
    const std::uint64_t p0 = 0xD2511F53ull * counter[0];
    const std::uint64_t p1 = 0xCD9E8D57ull * counter[2];
    counter = {static_cast<std::uint32_t>(p1 >> 32) ^ counter[1] ^ key[0], static_cast<std::uint32_t>(p1),
               static_cast<std::uint32_t>(p0 >> 32) ^ counter[3] ^ key[1], static_cast<std::uint32_t>(p0)};
    key[0] += 0x9E3779B9u;
    key[1] += 0xBB67AE85u;
  }
  return counter;
}

/// The key before any part: the first digits of pi behind the point.
inline constexpr std::uint64_t kRootKey = 0x243F6A8885A308D3ull;

/// Mixes one integer into a key; the results of different integers are unrelated.
inline std::uint64_t mix_key(std::uint64_t key, std::uint64_t part) {
  const auto block =
      philox4x32({static_cast<std::uint32_t>(part), static_cast<std::uint32_t>(part >> 32), 0x77697700u, 0u},
                 {static_cast<std::uint32_t>(key), static_cast<std::uint32_t>(key >> 32)});
  return (static_cast<std::uint64_t>(block[1]) << 32) | block[0];
}

/// Folds integers, e.g. (run seed, episode, decision, candidate), into one well-mixed 64-bit key: each part with the
/// key of those before it. Order matters; every prefix gives an unrelated key.
inline std::uint64_t fold_key(std::span<const std::uint64_t> parts) {
  std::uint64_t key = kRootKey;
  for (const std::uint64_t part : parts) key = mix_key(mix_key(kRootKey, key), part);
  return key;
}
inline std::uint64_t fold_key(std::initializer_list<std::uint64_t> parts) {
  return fold_key(std::span(parts.begin(), parts.size()));
}

/// Counter-based generator: the stream is a function of its key alone, so results depend neither on the order in
/// which episodes run nor on threads. Satisfies UniformRandomBitGenerator; the helpers below are portable where the
/// standard library's distributions are not.
class Rng {
 public:
  using result_type = std::uint32_t;
  explicit Rng(std::uint64_t key) : key_{static_cast<std::uint32_t>(key), static_cast<std::uint32_t>(key >> 32)} {}

  static constexpr result_type min() { return 0; }
  static constexpr result_type max() { return 0xFFFFFFFFu; }

  result_type operator()() {
    const auto lane = static_cast<std::uint32_t>(next_ & 3u);
    if (lane == 0) {
      const std::uint64_t block = next_ >> 2;
      block_ = philox4x32({static_cast<std::uint32_t>(block), static_cast<std::uint32_t>(block >> 32), 0u, 0u}, key_);
    }
    ++next_;
    return block_[lane];
  }

  /// Uniform in [0, 1) with 32 bits.
  double uniform() { return (*this)() * 0x1p-32; }
  double uniform(double low, double high) { return low + (high - low) * uniform(); }
  /// Uniform integer in [0, n), n > 0.
  std::uint32_t below(std::uint32_t n) {
    return static_cast<std::uint32_t>((static_cast<std::uint64_t>((*this)()) * n) >> 32);
  }
  bool chance(double probability) { return uniform() < probability; }

 private:
  std::array<std::uint32_t, 2> key_;
  std::array<std::uint32_t, 4> block_{};
  std::uint64_t next_ = 0;
};

}  // namespace wiw
