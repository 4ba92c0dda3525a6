// SPDX-License-Identifier: Apache-2.0
#include "wiw/panorama/cubemap.hpp"

#include <doctest/doctest.h>

#include <Eigen/Geometry>

#include "twin.hpp"
#include "wiw/core/error.hpp"

using namespace twin;

namespace {

/// Smooth function on the sphere.
float signal(const Eigen::Vector3d& d) {
  const Eigen::Vector3d n = d.normalized();
  return static_cast<float>(100 + 40 * n.x() - 30 * n.y() + 20 * n.z() + 25 * n.x() * n.z());
}

template <class Table, class T>
std::vector<T> look_up(const Table& table, const std::vector<T>& source) {
  std::vector<T> out(table.size());
  const RemapTarget<T> target{0, out.data()};
  remap(table, ImageView<const T>{source.data(), table.source, 1}, std::span<const RemapTarget<T>>(&target, 1));
  return out;
}

}  // namespace

TEST_CASE("faces look where they say") {
  const Size size{180, 360};
  std::vector<float> pano(size.pixels());
  for (int y = 0; y < size.height; ++y) {
    for (int x = 0; x < size.width; ++x)
      pano[static_cast<std::size_t>(y * size.width + x)] = signal(pixel_direction(x, y, size));
  }
  const int s = 33;  // odd: the middle pixel looks along the axis
  const auto faces = look_up(bilinear_to_cube(size, s), pano);
  const auto at = [&](int face, int row, int column) {
    return faces[static_cast<std::size_t>((face * s + row) * s + column)];
  };
  const Eigen::Vector3d axes[] = {{0, 0, -1}, {1, 0, 0}, {0, 0, 1}, {-1, 0, 0}, {0, 1, 0}, {0, -1, 0}};
  for (int face = 0; face < 6; ++face)
    CHECK(at(face, s / 2, s / 2) == doctest::Approx(signal(axes[face])).epsilon(1e-3));
  const double edge = 1.0 - 1.0 / s;
  CHECK(at(0, s / 2, s - 1) == doctest::Approx(signal({edge, 0, -1})).epsilon(1e-3));  // right of front
  CHECK(at(0, 0, s / 2) == doctest::Approx(signal({0, edge, -1})).epsilon(1e-3));      // top of front
  CHECK(at(1, s / 2, s - 1) == doctest::Approx(signal({1, 0, edge})).epsilon(1e-3));   // right of right: towards back
  CHECK(at(4, s - 1, s / 2) == doctest::Approx(signal({0, 1, -edge})).epsilon(1e-3));  // bottom of up meets front
  CHECK(at(5, 0, s / 2) == doctest::Approx(signal({0, -1, -edge})).epsilon(1e-3));     // top of down meets front
}

TEST_CASE("bilinear blending continues across every edge with the texel of the face glued there") {
  // The faces hold a function of direction alone, so folding to a wrong face, row or direction shows as a jump.
  const int s = 24;
  const Size size{90, 180};
  std::vector<float> faces;
  const Eigen::Vector3d axes[] = {{0, 0, -1}, {1, 0, 0}, {0, 0, 1}, {-1, 0, 0}, {0, 1, 0}, {0, -1, 0}};
  const Eigen::Vector3d rights[] = {{1, 0, 0}, {0, 0, 1}, {-1, 0, 0}, {0, 0, -1}, {1, 0, 0}, {1, 0, 0}};
  for (int face = 0; face < 6; ++face) {
    const Eigen::Vector3d down = axes[face].cross(rights[face]);
    for (int row = 0; row < s; ++row) {
      for (int column = 0; column < s; ++column) {
        const double a = (2 * column + 1.0) / s - 1;
        const double b = (2 * row + 1.0) / s - 1;
        faces.push_back(signal(axes[face] + a * rights[face] + b * down));
      }
    }
  }
  const BilinearTable table = bilinear_from_cube(s, size);
  CHECK(table.irregular.size() > 300);
  const auto pano = look_up(table, faces);
  double worst_error = 0.0;
  for (int y = 0; y < size.height; ++y) {
    for (int x = 0; x < size.width; ++x) {
      const float expected = signal(pixel_direction(x, y, size));
      worst_error = std::max(
          worst_error, static_cast<double>(std::abs(pano[static_cast<std::size_t>(y * size.width + x)] - expected)));
    }
  }
  // Texels are about 4 degrees wide and the signal moves up to 1.3 a degree; clamping at edges errs by 2 to 3.
  CHECK(worst_error < 0.6);
}

TEST_CASE("each irregular texel of a one-texel-wide border is where the unfolded cube has it") {
  const int s = 8;
  const BilinearTable table = bilinear_from_cube(s, {64, 128});
  for (const IrregularPixel& pixel : table.irregular) {
    double weight = 0.0;
    for (std::size_t k = 0; k < 4; ++k) {
      CHECK(pixel.row[k] >= 0);
      CHECK(pixel.row[k] < 6 * s);
      CHECK(pixel.column[k] >= 0);
      CHECK(pixel.column[k] < s);
      weight += pixel.weight[k];
    }
    CHECK(weight == doctest::Approx(1.0));
  }
}

TEST_CASE("nearest ids survive the way there and back where the cube is fine enough") {
  const Size size{16, 32};
  const auto ids = noise<std::uint32_t>(size, 1, 9);
  const auto faces = look_up(nearest_to_cube(size, 256), ids);
  CHECK(look_up(nearest_from_cube(256, size), faces) == ids);
  CHECK_THROWS_AS(cube_stack(0), ArgumentError);
}
