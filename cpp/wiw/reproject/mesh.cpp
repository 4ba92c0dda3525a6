// SPDX-License-Identifier: Apache-2.0
#include "wiw/reproject/mesh.hpp"

#include <algorithm>
#include <cmath>

namespace wiw::reproject {

namespace {

/// Pixel coordinates of the vertices along an axis of `count` pixels.
std::vector<double> vertex_positions(int count, bool ring) {
  std::vector<double> positions;
  if (ring) positions.push_back(-0.5);
  for (int i = 0; i < count; ++i) positions.push_back(i);
  if (ring) positions.push_back(count - 0.5);
  return positions;
}

/// Texel blocks for `quads` quads between those vertices; in the ring the outer pixel's own texel is read.
MeshLayout::Axis texel_axis(int count, bool ring, int quads) {
  MeshLayout::Axis axis;
  for (int q = 0; q < quads; ++q) {
    const int pixel = ring ? q - 1 : q;
    const bool before = pixel < 0;
    const bool after = ring && pixel >= count - 1;
    axis.texel.push_back(before ? 0 : after ? count - 2 : pixel);
    axis.begin.push_back(after ? 1.0F : 0.0F);
    axis.span.push_back(before || after ? 0.0F : 1.0F);
  }
  return axis;
}

/// Whether inverse depths b and c belong to one surface, given those before b and after c.
bool continuous(float a, float b, float c, float d, float cut) {
  const float step = c - b;
  const float size = std::abs(step);
  return size <= cut * std::max(b, c) || std::abs(step - (b - a)) <= 0.5F * size ||
         std::abs(step - (d - c)) <= 0.5F * size;
}

}  // namespace

MeshLayout::MeshLayout(const View& source) : view(source) {
  const bool ring = !view.panoramic;
  std::vector<double> across_positions = vertex_positions(view.size.width, ring);
  if (view.panoramic) across_positions.push_back(0.0);
  const std::vector<double> down_positions = vertex_positions(view.size.height, ring);
  rows = static_cast<int>(down_positions.size());
  columns = static_cast<int>(across_positions.size());
  rays = make_rays(view, across_positions, down_positions);
  across = texel_axis(view.size.width, ring, columns - 1);
  down = texel_axis(view.size.height, ring, rows - 1);
}

DepthMesh build_mesh(const MeshLayout& layout, const float* depth, float cut) {
  const Size& size = layout.view.size;
  const int ring = layout.view.panoramic ? 0 : 1;
  const int rows = layout.rows;
  const int columns = layout.columns;
  const auto at = [columns](int row, int column) { return static_cast<std::size_t>(row) * columns + column; };
  DepthMesh mesh;
  mesh.depth.resize(at(rows, 0));
  std::vector<float> inverse(mesh.depth.size());
  for (int row = 0; row < rows; ++row) {
    const float* from = depth + static_cast<std::size_t>(std::clamp(row - ring, 0, size.height - 1)) * size.width;
    for (int column = 0; column < columns; ++column) {
      const int pixel = ring ? std::clamp(column - 1, 0, size.width - 1) : column % size.width;
      const float value = from[pixel] > 0.0F && from[pixel] < kFar ? from[pixel] : kFar;
      mesh.depth[at(row, column)] = value;
      inverse[at(row, column)] = 1.0F / value;
    }
  }
  // Whether the vertices joined by the edge to the right of (below) each vertex are one surface.
  std::vector<std::uint8_t> right(inverse.size());
  std::vector<std::uint8_t> below(inverse.size());
  for (int row = 0; row < rows; ++row) {
    for (int column = 0; column + 1 < columns; ++column) {
      const int before = column > 0 ? column - 1 : (ring ? 0 : columns - 2);
      const int after = column + 2 < columns ? column + 2 : (ring ? columns - 1 : 1);
      right[at(row, column)] = continuous(inverse[at(row, before)], inverse[at(row, column)],
                                          inverse[at(row, column + 1)], inverse[at(row, after)], cut);
    }
    if (row + 1 == rows) break;
    const int before = std::max(row - 1, 0);
    const int after = std::min(row + 2, rows - 1);
    for (int column = 0; column < columns; ++column) {
      below[at(row, column)] = continuous(inverse[at(before, column)], inverse[at(row, column)],
                                          inverse[at(row + 1, column)], inverse[at(after, column)], cut);
    }
  }
  mesh.triangles.reserve(static_cast<std::size_t>(rows - 1) * (columns - 1));
  for (int row = 0; row + 1 < rows; ++row) {
    for (int column = 0; column + 1 < columns; ++column) {
      const bool upper = right[at(row, column)] != 0 && below[at(row, column)] != 0;
      const bool lower = right[at(row + 1, column)] != 0 && below[at(row, column + 1)] != 0;
      mesh.triangles.push_back(static_cast<std::uint8_t>((upper ? kUpperLeft : 0) | (lower ? kLowerRight : 0)));
    }
  }
  return mesh;
}

}  // namespace wiw::reproject
