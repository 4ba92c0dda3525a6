// SPDX-License-Identifier: Apache-2.0
#include "wiw/planner/resizer.hpp"

#include <doctest/doctest.h>

#include <algorithm>

#include "wiw/core/error.hpp"

using namespace wiw;
using namespace wiw::planner;

namespace {
std::vector<std::uint8_t> ramp(Size size) {
  std::vector<std::uint8_t> pixels;
  for (std::size_t i = 0; i < size.pixels(); ++i) {
    for (std::size_t c = 0; c < 3; ++c) pixels.push_back(static_cast<std::uint8_t>(37 * i + 11 * c));
  }
  return pixels;
}

/// One channel as an image of three.
std::vector<std::uint8_t> grey(const std::vector<int>& values) {
  std::vector<std::uint8_t> pixels;
  for (const int value : values) pixels.insert(pixels.end(), 3, static_cast<std::uint8_t>(value));
  return pixels;
}

std::vector<std::uint8_t> resized(const std::vector<std::uint8_t>& pixels, Size from, Size to, Keep keep) {
  std::vector<std::uint8_t> out(3 * to.pixels());
  Resizer(from, to, keep)(pixels.data(), 0, out.data());
  return out;
}

}  // namespace

TEST_CASE("shrinking is the mean over the area, fractions counted") {
  // (0 + 90 / 2) / 1.5 and (90 / 2 + 240) / 1.5
  CHECK(resized(grey({0, 90, 240}), {1, 3}, {1, 2}, Keep::kSphere) == grey({30, 190}));
}

TEST_CASE("growing is linear between centres, closed to a circle where it is a sphere") {
  const auto rows = grey({0, 100, 0, 100});
  const auto flat = resized(rows, {2, 2}, {4, 4}, Keep::kDirection);
  CHECK(std::equal(flat.begin(), flat.begin() + 12, grey({0, 25, 75, 100}).begin()));
  CHECK(resized(grey({0, 100}), {1, 2}, {1, 4}, Keep::kSphere) == grey({25, 25, 75, 75}));
}

TEST_CASE("directions stay: a wide image gets black rows, a high one loses some") {
  const auto wide = grey({10, 20, 30, 40});
  CHECK(resized(wide, {1, 4}, {3, 4}, Keep::kDirection) == grey({0, 0, 0, 0, 10, 20, 30, 40, 0, 0, 0, 0}));
  CHECK(resized(wide, {1, 4}, {2, 4}, Keep::kDirection) == grey({5, 10, 15, 20, 5, 10, 15, 20}));  // half a row each
  CHECK(resized(grey({1, 2, 3, 4}), {4, 1}, {2, 1}, Keep::kDirection) == grey({2, 3}));
  CHECK(resized(grey({200, 200, 200, 200}), {2, 2}, {6, 4}, Keep::kDirection) ==
        grey({0, 0, 0, 0, 200, 200, 200, 200, 200, 200, 200, 200, 200, 200, 200, 200, 200, 200, 200, 200, 0, 0, 0, 0}));
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
  const Resizer resizer(size, {4, 8}, Keep::kSphere);
  std::vector<std::uint8_t> a(96);
  std::vector<std::uint8_t> b(96);
  resizer(pixels.data(), 5, a.data());
  resizer(rolled.data(), 0, b.data());
  CHECK(a == b);
}

TEST_CASE("awkward ratios keep constants constant") {
  const std::vector<std::uint8_t> white(3 * 577 * 401, 255);
  std::vector<std::uint8_t> out(3 * 100 * 103);
  for (const Keep keep : {Keep::kSphere, Keep::kDirection}) {
    Resizer({577, 401}, {100, 103}, keep)(white.data(), 0, out.data());
    for (const auto value : out) REQUIRE(value == 255);
  }
  CHECK_THROWS_AS(Resizer({0, 5}, {1, 1}, Keep::kSphere), ArgumentError);
}
