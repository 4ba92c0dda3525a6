// SPDX-License-Identifier: Apache-2.0
#include "wiw/panorama/cubemap.hpp"

#include <algorithm>
#include <cmath>
#include <string>

#include "wiw/core/error.hpp"

namespace wiw::panorama {

namespace {

/// Outward axis of a face and the directions of growing columns and rows in it.
struct FaceFrame {
  Eigen::Vector3d axis, right, down;
};

const std::array<FaceFrame, kCubeFaces>& face_frames() {
  static const std::array<FaceFrame, kCubeFaces> frames{{
      {{0, 0, -1}, {1, 0, 0}, {0, -1, 0}},
      {{1, 0, 0}, {0, 0, 1}, {0, -1, 0}},
      {{0, 0, 1}, {-1, 0, 0}, {0, -1, 0}},
      {{-1, 0, 0}, {0, 0, -1}, {0, -1, 0}},
      {{0, 1, 0}, {1, 0, 0}, {0, 0, -1}},
      {{0, -1, 0}, {1, 0, 0}, {0, 0, 1}},
  }};
  // The top of `up` is where +Z lies behind the front, so its rows run towards -Z; `down` mirrors that.
  return frames;
}

struct FacePixel {
  int face;
  double x, y;  // pixel coordinates, 0 at the centre of the first pixel
};

FacePixel locate(const Eigen::Vector3d& direction, int size) {
  const auto& frames = face_frames();
  int best = 0;
  for (int face = 1; face < kCubeFaces; ++face) {
    if (direction.dot(frames[face].axis) > direction.dot(frames[best].axis)) best = face;
  }
  const double depth = direction.dot(frames[best].axis);
  const auto pixel = [&](const Eigen::Vector3d& side) {
    return (direction.dot(side) / depth + 1.0) / 2.0 * size - 0.5;
  };
  return {best, pixel(frames[best].right), pixel(frames[best].down)};
}

struct Texel {
  int row, column;  // in the face stack
};

/// Texel (row, column) of a face where one of the two may be -1 or `size`: folds the texel's centre over the cube's
/// edge onto the neighbouring face, which it hits in a texel centre.
Texel folded_texel(int face, int row, int column, int size) {
  if (row >= 0 && row < size && column >= 0 && column < size) return {face * size + row, column};
  const FaceFrame& frame = face_frames()[face];
  double a = (2.0 * column + 1.0) / size - 1.0;
  double b = (2.0 * row + 1.0) / size - 1.0;
  const double inside = 1.0 - 1.0 / size;
  a = std::clamp(a, -1.0, 1.0);
  b = std::clamp(b, -1.0, 1.0);
  const FacePixel hit = locate(frame.axis * inside + frame.right * a + frame.down * b, size);
  return {hit.face * size + static_cast<int>(std::lround(hit.y)), static_cast<int>(std::lround(hit.x))};
}

/// Moves the weight of the texel outside both edges of a corner evenly to the three that exist.
void spread_corner(int row, int column, int size, std::array<double, 4>& weights) {
  const bool vertical = row < 0 || row + 1 >= size;
  const bool horizontal = column < 0 || column + 1 >= size;
  if (!vertical || !horizontal) return;
  const std::size_t missing = (row < 0 ? 0 : 2) + (column < 0 ? 0 : 1);
  const double share = weights[missing] / 3.0;
  for (std::size_t k = 0; k < 4; ++k) weights[k] = k == missing ? 0.0 : weights[k] + share;
}

void append_edge(BilinearTable& table, int face, int row, int column, double fx, double fy, int size) {
  std::array<double, 4> weights{(1 - fx) * (1 - fy), fx * (1 - fy), (1 - fx) * fy, fx * fy};
  spread_corner(row, column, size, weights);
  std::array<std::int32_t, 4> rows{};
  std::array<std::int32_t, 4> columns{};
  for (int k = 0; k < 4; ++k) {
    // The missing corner has no weight; any valid texel stands in for it.
    const bool gone = weights[k] == 0.0;
    const Texel texel = gone ? Texel{face * size, 0} : folded_texel(face, row + k / 2, column + k % 2, size);
    rows[k] = texel.row;
    columns[k] = texel.column;
  }
  append_irregular(table, rows, columns, weights);
}

Coordinates cube_coordinates(const Size& panorama, int size) {
  check_panorama_size(panorama);
  Coordinates coordinates;
  for (const FaceFrame& frame : face_frames()) {
    for (int row = 0; row < size; ++row) {
      for (int column = 0; column < size; ++column) {
        const double a = (2.0 * column + 1.0) / size - 1.0;
        const double b = (2.0 * row + 1.0) / size - 1.0;
        const Eigen::Vector2d pixel = direction_pixel(frame.axis + a * frame.right + b * frame.down, panorama);
        coordinates.x.push_back(pixel.x());
        coordinates.y.push_back(pixel.y());
      }
    }
  }
  return coordinates;
}

}  // namespace

Size cube_stack(int face_size) {
  // Six faces of 5461 rows are the most that 15-bit row numbers hold.
  if (face_size < 1 || face_size > 5461) {
    throw ArgumentError("cube face: expected a side from 1 to 5461 pixels, got " + std::to_string(face_size));
  }
  return {kCubeFaces * face_size, face_size};
}

BilinearTable bilinear_to_cube(const Size& panorama, int face_size) {
  cube_stack(face_size);
  return bilinear_panorama_table(panorama, cube_coordinates(panorama, face_size));
}

NearestTable nearest_to_cube(const Size& panorama, int face_size) {
  cube_stack(face_size);
  return nearest_panorama_table(panorama, cube_coordinates(panorama, face_size));
}

BilinearTable bilinear_from_cube(int face_size, const Size& panorama) {
  BilinearTable table;
  table.source = cube_stack(face_size);
  check_panorama_size(panorama);
  for (int y = 0; y < panorama.height; ++y) {
    for (int x = 0; x < panorama.width; ++x) {
      const FacePixel pixel = locate(pixel_direction(x, y, panorama), face_size);
      const int row = static_cast<int>(std::floor(pixel.y));
      const int column = static_cast<int>(std::floor(pixel.x));
      if (row >= 0 && column >= 0 && row < face_size - 1 && column < face_size - 1) {
        append_regular(table, pixel.face * face_size + row, column, pixel.x - column, pixel.y - row);
      } else {
        append_edge(table, pixel.face, row, column, pixel.x - column, pixel.y - row, face_size);
      }
    }
  }
  return table;
}

NearestTable nearest_from_cube(int face_size, const Size& panorama) {
  NearestTable table;
  table.source = cube_stack(face_size);
  check_panorama_size(panorama);
  for (int y = 0; y < panorama.height; ++y) {
    for (int x = 0; x < panorama.width; ++x) {
      const FacePixel pixel = locate(pixel_direction(x, y, panorama), face_size);
      const int row = std::clamp(static_cast<int>(std::lround(pixel.y)), 0, face_size - 1);
      const int column = std::clamp(static_cast<int>(std::lround(pixel.x)), 0, face_size - 1);
      table.texel.push_back(pack_halves(column, pixel.face * face_size + row));
    }
  }
  return table;
}

}  // namespace wiw::panorama
