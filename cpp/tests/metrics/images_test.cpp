// SPDX-License-Identifier: Apache-2.0
#include <doctest/doctest.h>

#include <vector>

#include "wiw/core/error.hpp"
#include "wiw/metrics/psnr.hpp"
#include "wiw/metrics/ssim.hpp"

using namespace wiw;
using namespace wiw::metrics;

namespace {
struct Image {
  std::vector<std::uint8_t> values;
  Size size;
  Image(int height, int width, int level)
      : values(static_cast<std::size_t>(3 * height * width), static_cast<std::uint8_t>(level)), size{height, width} {}
  [[nodiscard]] ImageView<const std::uint8_t> view() const { return {values.data(), size, 3}; }
};
}  // namespace

TEST_CASE("a constant difference gives its textbook PSNR, whatever the weights") {
  const Image a(20, 40, 10);
  const Image b(20, 40, 15);
  for (const auto weighting : {Weighting::kUniform, Weighting::kLatitude}) {
    CHECK(psnr(a.view(), b.view(), 255, weighting) == doctest::Approx(20 * std::log10(255.0 / 5)));
  }
  CHECK(psnr(a.view(), a.view(), 255, Weighting::kUniform) == kPsnrCap);
}

TEST_CASE("an error at the pole counts less than one at the horizon") {
  const Image clean(64, 128, 100);
  Image pole(64, 128, 100);
  Image horizon(64, 128, 100);
  pole.values[0] = 200;
  horizon.values[3u * 128 * 32] = 200;
  CHECK(psnr(clean.view(), pole.view(), 255, Weighting::kLatitude) >
        psnr(clean.view(), horizon.view(), 255, Weighting::kLatitude) + 10);
  CHECK(psnr(clean.view(), pole.view(), 255, Weighting::kUniform) ==
        psnr(clean.view(), horizon.view(), 255, Weighting::kUniform));
}

TEST_CASE("constant images leave only the luminance term of SSIM") {
  const Image a(16, 24, 100);
  const Image b(16, 24, 120);
  const double c1 = 0.01 * 255 * 0.01 * 255;
  const double expected = (2 * 100 * 120 + c1) / (100 * 100 + 120 * 120 + c1);
  for (const auto weighting : {Weighting::kUniform, Weighting::kLatitude}) {
    CHECK(ssim(a.view(), b.view(), 255, weighting) == doctest::Approx(expected).epsilon(1e-4));
    CHECK(ssim(a.view(), a.view(), 255, weighting) == doctest::Approx(1));
  }
}

TEST_CASE("images that do not fit are refused") {
  CHECK_THROWS_AS(psnr(Image(4, 4, 0).view(), Image(4, 5, 0).view(), 255, Weighting::kUniform), ArgumentError);
  CHECK_THROWS_AS(ssim(Image(10, 20, 0).view(), Image(10, 20, 0).view(), 255, Weighting::kUniform), ArgumentError);
}
