// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <array>
#include <cstdint>
#include <cstring>
#include <span>

namespace wiw::scene::cache {

constexpr std::array<char, 8> kMagic{'w', 'i', 'w', 's', 'c', 'e', 'n', 'e'};
constexpr std::size_t kAlignment = 64;  // a cache line, and the widest vector register

struct CacheHeader {
  std::array<char, 8> magic = kMagic;
  std::uint32_t version = 0;
  std::uint32_t byte_order = 0x01020304;
  std::uint64_t file_bytes = 0;
  std::uint64_t table_offset = 0;  // the table runs to the end of the file
  std::uint64_t checksum = 0;      // of the header with this field zero, then the table
  std::array<std::uint64_t, 3> reserved{};
};
static_assert(sizeof(CacheHeader) == kAlignment);

/// 64-bit FNV-1a.
inline std::uint64_t hash(std::span<const std::uint8_t> bytes, std::uint64_t value = 0xCBF29CE484222325ULL) {
  for (const std::uint8_t byte : bytes) value = (value ^ byte) * 0x100000001B3ULL;
  return value;
}

/// One step of a chain: invertible, and no single bit of `word` changes a single bit of the result.
inline std::uint64_t mixed(std::uint64_t chain, std::uint64_t word) {
  const std::uint64_t both = chain ^ word;
  return (both ^ (both >> 32)) * 0x9E3779B97F4A7C15ULL;
}

/// Of an array of geometry: eight interleaved chains, so that it keeps up with memory.
inline std::uint64_t array_checksum(std::span<const std::uint8_t> bytes) {
  std::array<std::uint64_t, 8> chains{1, 2, 3, 4, 5, 6, 7, 8};
  std::array<std::uint64_t, 8> block{};
  for (std::size_t at = 0; at < bytes.size(); at += sizeof(block)) {
    const std::size_t left = bytes.size() - at;
    if (left < sizeof(block)) block.fill(0);
    std::memcpy(block.data(), bytes.data() + at, left < sizeof(block) ? left : sizeof(block));
    for (std::size_t i = 0; i < chains.size(); ++i) chains[i] = mixed(chains[i], block[i]);
  }
  std::uint64_t value = bytes.size();
  for (const std::uint64_t chain : chains) value = mixed(value, chain);
  return value;
}

/// Whether a checksum is the one that the file states. Builds for fuzzing let all pass, to reach what lies behind.
inline bool fits([[maybe_unused]] std::uint64_t computed, [[maybe_unused]] std::uint64_t stated) {
#ifdef FUZZING_BUILD_MODE_UNSAFE_FOR_PRODUCTION
  return true;
#else
  return computed == stated;
#endif
}

inline std::uint64_t checksum(CacheHeader header, std::span<const std::uint8_t> table) {
  header.checksum = 0;
  std::array<std::uint8_t, sizeof(CacheHeader)> bytes{};
  std::memcpy(bytes.data(), &header, sizeof(header));
  return hash(table, hash(bytes));
}

}  // namespace wiw::scene::cache
