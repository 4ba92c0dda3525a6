// SPDX-License-Identifier: Apache-2.0
#include "wiw/planner/assemble.hpp"

#include <doctest/doctest.h>

#include <algorithm>

#include "wiw/core/error.hpp"

using namespace wiw;
using namespace wiw::planner;
using enum action::Action;

namespace {
constexpr Size kSize{.height = 4, .width = 16};
constexpr std::size_t kBytes = 3 * 4 * 16;

std::vector<std::uint8_t> filled(std::size_t images) {
  std::vector<std::uint8_t> pixels(images * kBytes);
  for (std::size_t i = 0; i < pixels.size(); ++i) pixels[i] = static_cast<std::uint8_t>(i / kBytes + 1);
  return pixels;
}
}  // namespace

TEST_CASE("each cell shows its own source, repeated where plans agree, empty behind the end") {
  const Batch batch({{{kForward, kForward}, {kForward, kTurnLeft}, {kTurnLeft}}}, {.causal = true});
  const ViewIndex index = index_views(batch);
  CHECK(index.distinct.size() == 4);
  CHECK(index.cells == std::vector<int>{0, 1, 0, 2, 3, -1});

  const auto real = filled(1);
  const auto frames = filled(6);  // two rows of three frames: 1 2 3 and 4 5 6
  const Imagination imagined{.rollouts = {{.data = frames.data(),
                                           .rows = 2,
                                           .frames = 3,
                                           .size = kSize,
                                           .row_stride = 3 * kBytes,
                                           .frame_stride = kBytes}}};
  const ViewMaker maker({.kind = ViewKind::kPanorama, .size = kSize});
  std::vector<std::uint8_t> views(6 * kBytes, 99);
  make_dense_views(batch, index, {.images = {real.data()}, .size = kSize}, imagined, maker, views.data());
  const int expected[] = {2, 3, 2, 6, 1, 0};
  for (std::size_t cell = 0; cell < 6; ++cell) {
    const auto begin = views.begin() + static_cast<std::ptrdiff_t>(cell * kBytes);
    CHECK(std::count(begin, begin + kBytes, expected[cell]) == kBytes);
  }

  const std::int64_t candidates[] = {1, 2, 0, 1};
  const int ending[] = {6, 1, 3, 6};
  make_views(batch, index_ends(batch, candidates), {.images = {real.data()}, .size = kSize}, imagined, maker,
             views.data());
  for (std::size_t i = 0; i < 4; ++i) {
    const auto begin = views.begin() + static_cast<std::ptrdiff_t>(i * kBytes);
    CHECK(std::count(begin, begin + kBytes, ending[i]) == kBytes);
  }
  const std::int64_t beyond[] = {3};
  CHECK_THROWS_AS((void)index_ends(batch, beyond), ArgumentError);
}

TEST_CASE("a rollout of the wrong length is refused") {
  const Batch batch({{{kForward, kForward}}}, {});
  const Panoramas real{.images = {nullptr}, .size = kSize};
  CHECK_THROWS_AS(check_inputs(batch, real, {.rollouts = {{.rows = 1, .frames = 2}}}), ArgumentError);
  CHECK_THROWS_AS(check_inputs(batch, real, {}), ArgumentError);
  CHECK_THROWS_AS(check_inputs(batch, {}, {.rollouts = {{.rows = 1, .frames = 3}}}), ArgumentError);
}
