// SPDX-License-Identifier: Apache-2.0
#include "wiw/planner/view_maker.hpp"

#include <doctest/doctest.h>

#include "wiw/core/error.hpp"

using namespace wiw;
using namespace wiw::planner;

namespace {
constexpr Size kPanorama{.height = 32, .width = 64};

/// A panorama whose red tells the quarter: 0 front, 1 left, 2 back, 3 right, times 60.
std::vector<std::uint8_t> quarters() {
  std::vector<std::uint8_t> pixels(3 * kPanorama.pixels());
  for (int y = 0; y < kPanorama.height; ++y) {
    for (int x = 0; x < kPanorama.width; ++x) {
      const int right = (x + 8) / 16 % 4;  // 2 is the front
      pixels[3 * static_cast<std::size_t>(y * kPanorama.width + x)] = static_cast<std::uint8_t>(60 * ((6 - right) % 4));
    }
  }
  return pixels;
}

int centre_red(const std::uint8_t* view, Size size) {
  return view[3 * (size.height / 2 * size.width + size.width / 2)];
}
}  // namespace

TEST_CASE("turning left brings the left to the front") {
  const auto pixels = quarters();
  const Size size{8, 8};
  const ViewMaker front({.kind = ViewKind::kFront, .size = size});
  std::vector<std::uint8_t> view(front.bytes());
  for (int quarter = 0; quarter < 4; ++quarter) {
    front.from_panorama(pixels.data(), kPanorama, quarter * kPi / 2, view.data());
    CHECK(centre_red(view.data(), size) == 60 * quarter);
  }
  const ViewMaker whole({.kind = ViewKind::kPanorama, .size = {8, 16}});
  std::vector<std::uint8_t> small(whole.bytes());
  whole.from_panorama(pixels.data(), kPanorama, kPi / 2, small.data());
  CHECK(centre_red(small.data(), {8, 16}) == 60);
}

TEST_CASE("surround views are front, left, right, back") {
  const auto pixels = quarters();
  const Size size{8, 8};
  const ViewMaker maker({.kind = ViewKind::kSurround, .size = size});
  std::vector<std::uint8_t> views(maker.bytes());
  maker.from_panorama(pixels.data(), kPanorama, 0, views.data());
  const int expected[] = {0, 60, 180, 120};
  for (std::size_t i = 0; i < 4; ++i) CHECK(centre_red(views.data() + i * 3 * size.pixels(), size) == expected[i]);
}

TEST_CASE("perspective frames can only be the front") {
  const std::vector<std::uint8_t> frame(3 * 16 * 16, 7);
  std::vector<std::uint8_t> out(3 * 8 * 8);
  ViewMaker({.kind = ViewKind::kFront, .size = {8, 8}}).from_perspective(frame.data(), {16, 16}, out.data());
  CHECK(out[100] == 7);
  CHECK_THROWS_AS(
      ViewMaker({.kind = ViewKind::kPanorama, .size = {8, 16}}).from_perspective(frame.data(), {16, 16}, out.data()),
      ArgumentError);
}

TEST_CASE("a wide frame is shown in its own directions, black above and below") {
  const Size wide{.height = 8, .width = 16};
  std::vector<std::uint8_t> frame(3 * wide.pixels(), 9);
  std::vector<std::uint8_t> view(3 * 8 * 8);
  ViewMaker({.kind = ViewKind::kFront, .size = {8, 8}}).from_perspective(frame.data(), wide, view.data());
  for (std::size_t row = 0; row < 8; ++row) CHECK(view[3 * 8 * row] == (row < 2 || row >= 6 ? 0 : 9));
}

TEST_CASE("images without a pixel are refused") {
  const std::uint8_t* const none = nullptr;
  std::vector<std::uint8_t> out(3 * 8 * 16);
  for (const Size empty : {Size{64, 0}, Size{0, 128}, Size{0, 0}}) {
    for (const ViewKind kind : {ViewKind::kPanorama, ViewKind::kFront}) {
      const ViewMaker maker({.kind = kind, .size = {8, 16}});
      for (const double yaw : {0.0, 0.3}) {
        CHECK_THROWS_AS(maker.from_panorama(none, empty, yaw, out.data()), ArgumentError);
        CHECK_THROWS_AS(maker.depth(nullptr, empty, yaw, nullptr), ArgumentError);
      }
    }
    const ViewMaker front({.kind = ViewKind::kFront, .size = {8, 8}});
    CHECK_THROWS_AS(front.from_perspective(none, empty, out.data()), ArgumentError);
  }
}

TEST_CASE("depth becomes planar in a perspective view") {
  const std::vector<float> sphere(kPanorama.pixels(), 2.0f);
  const ViewMaker maker({.kind = ViewKind::kFront, .size = {9, 9}});
  std::vector<float> depth(81);
  maker.depth(sphere.data(), kPanorama, 0, depth.data());
  CHECK(depth[40] == doctest::Approx(2));
  CHECK(depth[36] == doctest::Approx(2 / std::sqrt(1 + 64.0 / 81)));  // left edge, ray (-8/9, 0, -1)
}
