// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <array>
#include <cstdint>
#include <cstring>
#include <span>

namespace wiw::cache {

constexpr std::array<char, 8> kMagic{'w', 'i', 'w', 's', 'c', 'e', 'n', 'e'};
constexpr std::size_t kAlignment = 64;  // a cache line, and the widest vector register

struct Header {
  std::array<char, 8> magic = kMagic;
  std::uint32_t version = 0;
  std::uint32_t byte_order = 0x01020304;
  std::uint64_t file_bytes = 0;
  std::uint64_t table_offset = 0;  // the table runs to the end of the file
  std::uint64_t checksum = 0;      // of the header with this field zero, then the table
  std::array<std::uint64_t, 3> reserved{};
};
static_assert(sizeof(Header) == kAlignment);

/// 64-bit FNV-1a.
inline std::uint64_t hash(std::span<const std::uint8_t> bytes, std::uint64_t value = 0xCBF29CE484222325ULL) {
  for (const std::uint8_t byte : bytes) value = (value ^ byte) * 0x100000001B3ULL;
  return value;
}

inline std::uint64_t checksum(Header header, std::span<const std::uint8_t> table) {
  header.checksum = 0;
  std::array<std::uint8_t, sizeof(Header)> bytes{};
  std::memcpy(bytes.data(), &header, sizeof(header));
  return hash(table, hash(bytes));
}

}  // namespace wiw::cache
