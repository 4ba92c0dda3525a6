// SPDX-License-Identifier: Apache-2.0
#include "wiw/planner/resizer.hpp"

#include <doctest/doctest.h>

#include "wiw/core/error.hpp"

using namespace wiw;

namespace {
std::vector<std::uint8_t> ramp(Size size) {
  std::vector<std::uint8_t> pixels;
  for (std::size_t i = 0; i < size.pixels(); ++i) {
    for (std::size_t c = 0; c < 3; ++c) pixels.push_back(static_cast<std::uint8_t>(37 * i + 11 * c));
  }
  return pixels;
}
}  // namespace

TEST_CASE("shrinking is the mean over the area, fractions counted") {
  const std::vector<std::uint8_t> row = {0, 0, 0, 90, 90, 90, 240, 240, 240};
  std::vector<std::uint8_t> out(6);
  Resizer({1, 3}, {1, 2}, false)(row.data(), 0, out.data());
  CHECK(out[0] == 30);   // (0 + 90 / 2) / 1.5
  CHECK(out[3] == 190);  // (90 / 2 + 240) / 1.5
}

TEST_CASE("growing is linear between centres, closed to a circle where asked") {
  const std::vector<std::uint8_t> row = {0, 0, 0, 100, 100, 100};
  std::vector<std::uint8_t> out(12);
  Resizer({1, 2}, {1, 4}, false)(row.data(), 0, out.data());
  CHECK(out[0] == 0);
  CHECK(out[3] == 25);
  CHECK(out[9] == 100);
  Resizer({1, 2}, {1, 4}, true)(row.data(), 0, out.data());
  CHECK(out[0] == 25);
  CHECK(out[9] == 75);
}

TEST_CASE("a shift is a roll before resizing") {
  const Size size{9, 16};
  const auto pixels = ramp(size);
  auto rolled = pixels;
  for (int y = 0; y < 9; ++y) {
    for (int x = 0; x < 16; ++x) {
      for (int c = 0; c < 3; ++c) rolled[3 * (16 * y + (x + 5) % 16) + c] = pixels[3 * (16 * y + x) + c];
    }
  }
  const Resizer resizer(size, {4, 8}, true);
  std::vector<std::uint8_t> a(96);
  std::vector<std::uint8_t> b(96);
  resizer(pixels.data(), 5, a.data());
  resizer(rolled.data(), 0, b.data());
  CHECK(a == b);
}

TEST_CASE("awkward ratios keep constants constant") {
  const std::vector<std::uint8_t> white(3 * 577 * 401, 255);
  std::vector<std::uint8_t> out(3 * 100 * 103);
  Resizer({577, 401}, {100, 103}, false)(white.data(), 0, out.data());
  for (const auto value : out) REQUIRE(value == 255);
  CHECK_THROWS_AS(Resizer({0, 5}, {1, 1}, false), ArgumentError);
}
