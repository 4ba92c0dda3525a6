// SPDX-License-Identifier: Apache-2.0
#include "wiw/reproject/mesh.hpp"

#include <algorithm>
#include <array>
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
    axis.texel.push_back(static_cast<std::uint32_t>(before ? 0 : after ? count - 2 : pixel));
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

/// Which neighbouring vertices are one surface: the edge to the right of and below each vertex.
struct Edges {
  std::vector<std::uint8_t> right, below;
};

Edges find_edges(const MeshLayout& layout, const std::vector<float>& depth, float cut) {
  const int rows = layout.rows;
  const int columns = layout.columns;
  const bool wraps = layout.view.panoramic;
  std::vector<float> inverse(depth.size());
  std::transform(depth.begin(), depth.end(), inverse.begin(), [](float d) { return 1.0F / d; });
  Edges edges{std::vector<std::uint8_t>(depth.size()), std::vector<std::uint8_t>(depth.size())};
  for (int row = 0; row < rows; ++row) {
    const std::size_t start = static_cast<std::size_t>(row) * columns;
    const float* here = inverse.data() + start;
    const auto joined = [&](int before, int column, int after) {
      return continuous(here[before], here[column], here[column + 1], here[after], cut);
    };
    for (int column = 1; column + 2 < columns; ++column) {
      edges.right[start + column] = joined(column - 1, column, column + 2);
    }
    edges.right[start] = joined(wraps ? columns - 2 : 0, 0, std::min(2, columns - 1));
    edges.right[start + columns - 2] = joined(std::max(columns - 3, 0), columns - 2, wraps ? 1 : columns - 1);
    if (row + 1 == rows) break;
    const float* above = inverse.data() + static_cast<std::size_t>(std::max(row - 1, 0)) * columns;
    const float* below = here + columns;
    const float* beyond = inverse.data() + static_cast<std::size_t>(std::min(row + 2, rows - 1)) * columns;
    for (int column = 0; column < columns; ++column) {
      edges.below[start + column] = continuous(above[column], here[column], below[column], beyond[column], cut);
    }
  }
  return edges;
}

/// Part of a quad, as fractions of it.
struct Part {
  float x0, x1, y0, y1;
};

/// Appends a part of quad (row, column) whose surface continues from the given vertices, one per corner.
void append_fringe(const MeshLayout& layout, const std::vector<float>& depth, int row, int column, const Part& part,
                   const std::array<int, 4>& from, FringeQuads& fringe) {
  const RayTable& rays = layout.rays;
  const auto mix = [](float a, float b, float t) { return a + t * (b - a); };
  for (int corner = 0; corner < 4; ++corner) {
    const float fx = corner % 2 == 0 ? part.x0 : part.x1;
    const float fy = corner / 2 == 0 ? part.y0 : part.y1;
    // Rays are blended linearly: over a pixel the difference to turning them is far below a texel.
    const float m = mix(rays.m[row], rays.m[row + 1], fy);
    fringe.ray_x[corner].push_back(mix(rays.x[column], rays.x[column + 1], fx) * m);
    fringe.ray_z[corner].push_back(mix(rays.z[column], rays.z[column + 1], fx) * m);
    fringe.ray_y[corner].push_back(mix(rays.y[row], rays.y[row + 1], fy));
    const int vertex_row = row + from[corner] / 2;
    const int vertex_column = column + from[corner] % 2;
    fringe.depth[corner].push_back(depth[static_cast<std::size_t>(vertex_row) * layout.columns + vertex_column]);
  }
  const MeshLayout::Axis& across = layout.across;
  const MeshLayout::Axis& down = layout.down;
  fringe.triangles.push_back(kUpperLeft | kLowerRight);
  fringe.texel.push_back(across.texel[column] | (down.texel[row] << 16));
  fringe.begin_x.push_back(across.begin[column] + across.span[column] * part.x0);
  fringe.span_x.push_back(across.span[column] * (part.x1 - part.x0));
  fringe.begin_y.push_back(down.begin[row] + down.span[row] * part.y0);
  fringe.span_y.push_back(down.span[row] * (part.y1 - part.y0));
}

/// The nearer sides of a quad whose corners are not one surface.
void append_cut_quad(const MeshLayout& layout, const DepthMesh& mesh, const Edges& edges, int row, int column,
                     float cut, FringeQuads& fringe) {
  const std::size_t corner00 = static_cast<std::size_t>(row) * layout.columns + column;
  const std::size_t corner10 = corner00 + layout.columns;
  const std::array<float, 4> depth{mesh.depth[corner00], mesh.depth[corner00 + 1], mesh.depth[corner10],
                                   mesh.depth[corner10 + 1]};
  const float farthest = *std::max_element(depth.begin(), depth.end());
  const auto nearer = [&](int corner) { return depth[corner] < (1.0F - cut) * farthest; };
  const auto append = [&](const Part& part, const std::array<int, 4>& from) {
    append_fringe(layout, mesh.depth, row, column, part, from, fringe);
  };
  if (edges.below[corner00] != 0 && edges.below[corner00 + 1] != 0) {
    if (nearer(0) || nearer(2)) append({0.0F, 0.5F, 0.0F, 1.0F}, {0, 0, 2, 2});
    if (nearer(1) || nearer(3)) append({0.5F, 1.0F, 0.0F, 1.0F}, {1, 1, 3, 3});
  } else if (edges.right[corner00] != 0 && edges.right[corner10] != 0) {
    if (nearer(0) || nearer(1)) append({0.0F, 1.0F, 0.0F, 0.5F}, {0, 1, 0, 1});
    if (nearer(2) || nearer(3)) append({0.0F, 1.0F, 0.5F, 1.0F}, {2, 3, 2, 3});
  } else {
    for (int corner = 0; corner < 4; ++corner) {
      if (!nearer(corner)) continue;
      const float x = 0.5F * static_cast<float>(corner % 2);
      const float y = 0.5F * static_cast<float>(corner / 2);
      append({x, x + 0.5F, y, y + 0.5F}, {corner, corner, corner, corner});
    }
  }
}

/// The image's depths at the vertices.
std::vector<float> vertex_depths(const MeshLayout& layout, const float* depth) {
  const Size& size = layout.view.size;
  const int ring = layout.view.panoramic ? 0 : 1;
  std::vector<float> vertices;
  vertices.reserve(static_cast<std::size_t>(layout.rows) * layout.columns);
  for (int row = 0; row < layout.rows; ++row) {
    const float* from = depth + static_cast<std::size_t>(std::clamp(row - ring, 0, size.height - 1)) * size.width;
    for (int column = 0; column < layout.columns; ++column) {
      const int pixel = ring != 0 ? std::clamp(column - 1, 0, size.width - 1) : (column < size.width ? column : 0);
      vertices.push_back(from[pixel] > 0.0F && from[pixel] < kFar ? from[pixel] : kFar);
    }
  }
  return vertices;
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
  DepthMesh mesh;
  mesh.depth = vertex_depths(layout, depth);
  const Edges edges = find_edges(layout, mesh.depth, cut);
  mesh.triangles.reserve(static_cast<std::size_t>(layout.rows - 1) * (layout.columns - 1));
  for (int row = 0; row + 1 < layout.rows; ++row) {
    for (int column = 0; column + 1 < layout.columns; ++column) {
      const std::size_t corner = static_cast<std::size_t>(row) * layout.columns + column;
      const bool upper = (edges.right[corner] & edges.below[corner]) != 0;
      const bool lower = (edges.right[corner + layout.columns] & edges.below[corner + 1]) != 0;
      mesh.triangles.push_back(static_cast<std::uint8_t>((upper ? kUpperLeft : 0) | (lower ? kLowerRight : 0)));
      if (!upper || !lower) append_cut_quad(layout, mesh, edges, row, column, cut, mesh.fringe);
    }
  }
  return mesh;
}

}  // namespace wiw::reproject
