// SPDX-License-Identifier: Apache-2.0
#include <doctest/doctest.h>

#include "twin.hpp"
#include "wiw/core/error.hpp"
#include "wiw/panorama/resize.hpp"
#include "wiw/panorama/roll.hpp"

using namespace twin;

TEST_CASE("a left turn of 22.5 degrees moves columns right by W / 16") {
  const Size size{4, 64};
  const auto pano = noise<std::uint8_t>(size, 3, 1);
  const ImageView<const std::uint8_t> view{pano.data(), size, 3};
  for (const int turns : {0, 1, 4, 15, -1, -17}) {
    std::vector<std::uint8_t> out(pano.size());
    rotate(view, radians(22.5 * turns), Interpolation::kBilinear, out.data());
    const ImageView<const std::uint8_t> turned{out.data(), size, 3};
    for (int x = 0; x < size.width; ++x) CHECK(turned.at(2, x)[1] == texel(view, 2, x - 4 * turns, 1));
  }
}

TEST_CASE("other angles blend the two columns that the new one falls between") {
  const Size size{3, 40};
  const auto bytes = noise<std::uint8_t>(size, 3, 2);
  const auto floats = noise<float>(size, 1, 3);
  for (const double yaw : {0.1, 3.0, -0.07, -10.0}) {
    std::vector<std::uint8_t> out(bytes.size());
    std::vector<float> out_floats(floats.size());
    rotate(ImageView<const std::uint8_t>{bytes.data(), size, 3}, yaw, Interpolation::kBilinear, out.data());
    rotate(ImageView<const float>{floats.data(), size, 1}, yaw, Interpolation::kBilinear, out_floats.data());
    for (int x = 0; x < size.width; ++x) {
      const double source = x - yaw / (2 * kPi) * size.width;
      const int left = static_cast<int>(std::floor(source));
      const double f = source - left;
      const ImageView<const std::uint8_t> a{bytes.data(), size, 3};
      const ImageView<const float> b{floats.data(), size, 1};
      const auto i = static_cast<std::size_t>(size.width + x);
      CHECK(std::abs(out[3 * i] - ((1 - f) * texel(a, 1, left, 0) + f * texel(a, 1, left + 1, 0))) < 0.52);
      CHECK(std::abs(out_floats[i] - ((1 - f) * texel(b, 1, left, 0) + f * texel(b, 1, left + 1, 0))) < 1e-3);
    }
  }
}

TEST_CASE("ids turn by the nearest whole column or not at all") {
  const Size size{1, 8};
  const std::vector<std::uint32_t> ids{0, 1, 2, 3, 4, 5, 6, 7};
  std::vector<std::uint32_t> out(8);
  rotate(ImageView<const std::uint32_t>{ids.data(), size, 1}, radians(50), Interpolation::kNearest, out.data());
  CHECK(out == std::vector<std::uint32_t>{7, 0, 1, 2, 3, 4, 5, 6});
  CHECK_THROWS_AS(
      rotate(ImageView<const std::uint32_t>{ids.data(), size, 1}, radians(50), Interpolation::kBilinear, out.data()),
      ArgumentError);
}

TEST_CASE("shrinking takes the mean over each pixel's area") {
  const Size from{9, 14};
  const auto bytes = noise<std::uint8_t>(from, 3, 4);
  for (const Size to : {Size{9, 14}, Size{4, 5}, Size{1, 1}, Size{9, 3}, Size{3, 7}}) {
    std::vector<std::uint8_t> out(to.pixels() * 3);
    resize_area(ImageView<const std::uint8_t>{bytes.data(), from, 3}, to, out.data());
    for (int y = 0; y < to.height; ++y) {
      for (int x = 0; x < to.width; ++x) {
        double sum = 0.0;
        for (int v = 0; v < from.height; ++v) {
          const double high = std::max(0.0, std::min(v + 1.0, (y + 1.0) * from.height / to.height) -
                                                std::max<double>(v, y * 1.0 * from.height / to.height));
          for (int u = 0; u < from.width; ++u) {
            const double wide = std::max(0.0, std::min(u + 1.0, (x + 1.0) * from.width / to.width) -
                                                  std::max<double>(u, x * 1.0 * from.width / to.width));
            sum += high * wide * bytes[static_cast<std::size_t>((v * from.width + u) * 3 + 2)];
          }
        }
        const double mean = sum * static_cast<double>(to.pixels()) / static_cast<double>(from.pixels());
        CHECK(std::abs(out[static_cast<std::size_t>((y * to.width + x) * 3 + 2)] - mean) < 0.501);
      }
    }
  }
  std::vector<std::uint8_t> out(3 * 15 * 9);
  CHECK_THROWS_AS(resize_area(ImageView<const std::uint8_t>{bytes.data(), from, 3}, {9, 15}, out.data()),
                  ArgumentError);
}
