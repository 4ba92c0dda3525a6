// SPDX-License-Identifier: Apache-2.0
#include "wiw/panorama/remap.hpp"

#include <doctest/doctest.h>

#include <set>
#include <string>

#include "twin.hpp"
#include "wiw/core/error.hpp"
#include "wiw/panorama/perspective.hpp"

using namespace twin;

namespace {

/// Largest difference between a plan's view and the twin's.
template <class T>
double worst(const PerspectivePlan& plan, ImageView<const T> pano, double yaw) {
  const Size& size = plan.view().size;
  std::vector<T> out(size.pixels() * static_cast<std::size_t>(pano.channels));
  plan.apply(pano.data, 1, pano.channels, std::span(&yaw, 1), Interpolation::kBilinear, out.data());
  double largest = 0.0;
  const T* value = out.data();
  for (int v = 0; v < size.height; ++v) {
    for (int u = 0; u < size.width; ++u) {
      for (int c = 0; c < pano.channels; ++c, ++value) {
        const double expected = sample(pano, ray(u, v, plan.view(), yaw), c);
        largest = std::max(largest, std::abs(static_cast<double>(*value) - expected));
      }
    }
  }
  return largest;
}

}  // namespace

TEST_CASE("views of noise equal the twin at the seam, at both poles and anywhere else") {
  const Size size{72, 128};
  for (const int channels : {1, 3, 4}) {
    const auto bytes = noise<std::uint8_t>(size, channels, 1);
    const auto floats = noise<float>(size, channels, 2);
    for (const double pitch : {0.0, 30.0, -45.0, 90.0, -90.0}) {
      // The narrow view makes several output pixels fall between the last row's centre and the pole.
      for (const double hfov : {4.0, 90.0, 140.0}) {
        const PerspectivePlan plan(size, {{21, 33}, radians(hfov), radians(pitch)});
        for (const double yaw : {0.0, 22.5, -90.0, 180.0, 7.3, 400.1}) {
          CAPTURE(pitch);
          CAPTURE(hfov);
          CAPTURE(yaw);
          CHECK(worst(plan, ImageView<const std::uint8_t>{bytes.data(), size, channels}, radians(yaw)) < 0.56);
          CHECK(worst(plan, ImageView<const float>{floats.data(), size, channels}, radians(yaw)) < 1e-3);
        }
      }
    }
  }
}

TEST_CASE("tiny panoramas, one row included") {
  for (const Size size : {Size{1, 2}, Size{2, 2}, Size{1, 8}, Size{3, 4}}) {
    const auto bytes = noise<std::uint8_t>(size, 3, 3);
    const PerspectivePlan plan(size, {{9, 11}, radians(100), radians(40)});
    CHECK(worst(plan, ImageView<const std::uint8_t>{bytes.data(), size, 3}, 0.3) < 0.56);
  }
}

TEST_CASE("every instruction set gives the same bytes, whatever the shift") {
  const Size size{64, 96};
  const auto bytes = noise<std::uint8_t>(size, 3, 4);
  const PerspectiveView view{{37, 41}, radians(110), radians(20)};
  const BilinearTable table = bilinear_panorama_table(size, perspective_coordinates(size, view));
  for (int shift = 0; shift < size.width; shift += 5) {
    std::vector<std::uint8_t> expected(3 * table.size());
    const RemapTarget<std::uint8_t> slow{shift, expected.data()};
    remap(table, {bytes.data(), size, 3}, std::span(&slow, 1), Isa::kScalar);
    for (const Isa isa : {Isa::kAvx2, Isa::kAvx512}) {
      if (isa > native_isa()) continue;
      std::vector<std::uint8_t> out(3 * table.size() + 64, 77);
      const RemapTarget<std::uint8_t> fast{shift, out.data()};
      remap(table, {bytes.data(), size, 3}, std::span(&fast, 1), isa);
      CHECK(std::equal(expected.begin(), expected.end(), out.begin()));
      CHECK(std::all_of(out.begin() + static_cast<std::ptrdiff_t>(expected.size()), out.end(),
                        [](std::uint8_t b) { return b == 77; }));  // nothing written past the end
    }
  }
}

TEST_CASE("groups read the same as blocks one by one") {
  const Size size{90, 160};
  const std::size_t images = 3;
  const auto bytes = noise<std::uint8_t>({static_cast<int>(images) * size.height, size.width}, 3, 7);
  std::set<int> rows;  // each number of them has a kernel of its own
  for (const double pitch : {0.0, 25.0, -60.0, 90.0}) {
    for (const double hfov : {5.0, 60.0, 105.0, 140.0}) {
      const PerspectiveView view{{45, 60}, radians(hfov), radians(pitch)};
      BilinearTable table = bilinear_panorama_table(size, perspective_coordinates(size, view));
      for (const BlockGroup& group : table.groups) rows.insert(group.rows);
      std::vector<std::vector<std::uint8_t>> fast, slow;
      for (int pass = 0; pass < 2; ++pass) {
        std::vector<std::vector<std::uint8_t>>& out = pass == 0 ? fast : slow;
        std::vector<RemapTarget<std::uint8_t>> targets;
        for (std::size_t image = 0; image < images; ++image) {
          for (const int shift : {0, 1, 40, 77, 159}) {
            out.emplace_back(3 * table.size() + 64, std::uint8_t{77});
            targets.push_back({shift, nullptr, image});
          }
        }
        for (std::size_t i = 0; i < targets.size(); ++i) targets[i].out = out[i].data();
        remap(table, {bytes.data(), size, 3}, std::span<const RemapTarget<std::uint8_t>>(targets));
        table.groups.clear();
      }
      CHECK(fast == slow);
    }
  }
  CHECK(rows == std::set<int>{0, 1, 2, 3, 4});
}

TEST_CASE("groups know where their pixels read and stay inside the source") {
  const Size size{40, 64};
  std::vector<std::uint32_t> texel;
  const auto append = [&](int row, int column) {
    for (int i = 0; i < 16; ++i) texel.push_back(pack_halves(column + i / 2, row + i / 8));
  };
  append(10, 20);
  append(36, 20);  // blocks of rows 36 and 37 end in row 38: nothing is loaded from the last row
  append(37, 20);
  for (int i = 0; i < 16; ++i) texel.push_back(pack_halves(20, 5 + 5 * (i % 8 / 4)));
  for (int i = 0; i < 16; ++i) texel.push_back(pack_halves(20 + 2 * i, 5));
  for (int i = 0; i < 16; ++i) texel.push_back(pack_halves(20, 5 + i % 4));
  texel.push_back(0);
  const std::vector<BlockGroup> groups = find_groups(texel, size);
  REQUIRE(groups.size() == 6);
  CHECK(groups[0].row[0] == 10);
  CHECK(groups[0].row[1] == 11);
  CHECK(groups[0].column[0] == 20);
  CHECK(groups[0].column[1] == 24);
  CHECK(groups[0].first == 20);
  CHECK(groups[0].last == 27);
  CHECK(groups[0].rows == 1);
  CHECK(groups[0].place[3] == 3);
  CHECK(groups[0].place[15] == 32 + 9);
  CHECK(groups[1].rows == 1);
  CHECK(groups[2].rows == 0);  // the last row's load may pass its end
  CHECK(groups[3].rows == 0);  // six rows
  CHECK(groups[4].rows == 0);  // fifteen columns a half
  CHECK(groups[5].rows == 4);
  CHECK(groups[5].place[6] == 2 * 64);
}

TEST_CASE("one cached plan serves several yaws and panoramas at once") {
  const Size size{32, 64};
  const auto batch = noise<std::uint8_t>({3 * size.height, size.width}, 3, 5);
  const PerspectivePlan plan(size, {{8, 10}, radians(80), 0.1});
  const std::vector<double> yaws{0.0, radians(22.5), 0.123, radians(-90)};
  const std::size_t view = 8 * 10 * 3;
  std::vector<std::uint8_t> all(3 * yaws.size() * view);
  plan.apply(batch.data(), 3, 3, yaws, Interpolation::kBilinear, all.data());
  for (std::size_t b = 0; b < 3; ++b) {
    for (std::size_t y = 0; y < yaws.size(); ++y) {
      std::vector<std::uint8_t> one(view);
      plan.apply(batch.data() + b * size.pixels() * 3, 1, 3, std::span(&yaws[y], 1), Interpolation::kBilinear,
                 one.data());
      CHECK(
          std::equal(one.begin(), one.end(), all.begin() + static_cast<std::ptrdiff_t>((b * yaws.size() + y) * view)));
    }
  }
  CHECK(plan.column_shift(radians(22.5)) == 60);  // a left turn looks at columns further left
  CHECK(plan.column_shift(radians(-90)) == 16);
  CHECK(!plan.column_shift(0.123).has_value());
}

TEST_CASE("nearest look-up copies existing ids and never blends") {
  const Size size{16, 32};
  const auto ids = noise<std::uint32_t>(size, 1, 6);
  const PerspectivePlan plan(size, {{20, 20}, radians(100), 0.2});
  const double yaw = 0.4;
  std::vector<std::uint32_t> out(400);
  plan.apply(ids.data(), 1, 1, std::span(&yaw, 1), Interpolation::kNearest, out.data());
  for (int v = 0; v < 20; ++v) {
    for (int u = 0; u < 20; ++u) {
      const Eigen::Vector2d pixel = direction_pixel(ray(u, v, plan.view(), yaw), size);
      const int row = std::clamp(static_cast<int>(std::floor(pixel.y() + 0.5)), 0, size.height - 1);
      const int column = static_cast<int>(std::floor(pixel.x() + 0.5 + size.width)) % size.width;
      CHECK(out[static_cast<std::size_t>(v * 20 + u)] == ids[static_cast<std::size_t>(row * size.width + column)]);
    }
  }
  CHECK_THROWS_AS(plan.apply(ids.data(), 1, 1, std::span(&yaw, 1), Interpolation::kBilinear, out.data()),
                  ArgumentError);
}
