// SPDX-License-Identifier: Apache-2.0
// Plain data only: included by the kernels, which are compiled once per instruction set.
#pragma once

#include <cstddef>
#include <cstdint>

namespace wiw::panorama {

constexpr std::size_t kGroup = 16;  // output pixels

/// Where sixteen neighbouring output pixels of a bilinear table read, eight and eight: neighbours read neighbours, so
/// a few rows of 32 bytes hold all their blocks, and loading those takes far fewer loads than block by block.
struct BlockGroup {
  std::uint16_t row[2];       // of each half: the uppermost row of its blocks
  std::uint16_t column[2];    // and the leftmost column
  std::uint16_t first, last;  // least and greatest column of the sixteen blocks
  std::uint16_t rows;         // blocks of a half begin in so many rows at most; 0: the group cannot be read in this way
  std::uint8_t place[kGroup];  // of each block's first byte: 64 x its row + 32 x its half + the byte in it
};

constexpr int kMostGroupRows = 4;

}  // namespace wiw::panorama
