// SPDX-License-Identifier: Apache-2.0
#include "wiw/reproject/mesh.hpp"

#include <algorithm>
#include <array>
#include <cmath>

#include "wiw/reproject/raster.hpp"

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
std::uint8_t continuous(float a, float b, float c, float d, float cut) {
  const float step = c - b;
  const float size = std::abs(step);
  // Bitwise on purpose: branches would keep the loops around this from being vectorised.
  return static_cast<std::uint8_t>(static_cast<int>(size <= cut * (b > c ? b : c)) |
                                   static_cast<int>(std::abs(step - (b - a)) <= 0.5F * size) |
                                   static_cast<int>(std::abs(step - (d - c)) <= 0.5F * size));
}

/// Rows of inverse depth around the one in hand, and which neighbouring vertices are one surface: the edges to the
/// right in a row of vertices, and below it.
class EdgeFinder {
 public:
  EdgeFinder(const MeshLayout& layout, const std::vector<float>& depth, float cut)
      : columns_(layout.columns), last_row_(layout.rows - 1), wraps_(layout.view.panoramic), cut_(cut), depth_(depth) {
    for (auto& row : inverse_) row.resize(static_cast<std::size_t>(columns_));
    for (int row = 0; row < std::min(3, layout.rows); ++row) load(row);
  }

  /// Edges between columns j and j + 1.
  void right(int row, std::vector<std::uint8_t>& joined) {
    const float* here = inverse(row);
    const int last = columns_ - 1;
    for (int j = 1; j + 2 <= last; ++j) joined[j] = continuous(here[j - 1], here[j], here[j + 1], here[j + 2], cut_);
    joined[0] = continuous(here[wraps_ ? last - 1 : 0], here[0], here[1], here[std::min(2, last)], cut_);
    joined[last - 1] =
        continuous(here[std::max(last - 2, 0)], here[last - 1], here[last], here[wraps_ ? 1 : last], cut_);
  }

  /// Edges between rows `row` and `row` + 1; called once for every row in turn.
  void below(int row, std::vector<std::uint8_t>& joined) {
    if (row + 2 <= last_row_) load(row + 2);
    const float* a = inverse(std::max(row - 1, 0));
    const float* b = inverse(row);
    const float* c = inverse(row + 1);
    const float* d = inverse(std::min(row + 2, last_row_));
    for (int j = 0; j < columns_; ++j) joined[j] = continuous(a[j], b[j], c[j], d[j], cut_);
  }

 private:
  [[nodiscard]] const float* inverse(int row) const { return inverse_[static_cast<std::size_t>(row) % 4].data(); }
  void load(int row) {
    const float* from = depth_.data() + static_cast<std::size_t>(row) * columns_;
    float* to = inverse_[static_cast<std::size_t>(row) % 4].data();
    for (int j = 0; j < columns_; ++j) to[j] = 1.0F / from[j];
  }

  int columns_, last_row_;
  bool wraps_;
  float cut_;
  const std::vector<float>& depth_;
  std::array<std::vector<float>, 4> inverse_;
};

/// Edges around one row of quads.
struct Edges {
  std::vector<std::uint8_t> above, below;  // along the upper and the lower row of vertices
  std::vector<std::uint8_t> down;          // between the two rows
};

/// Part of a quad, as fractions of it.
struct QuadPart {
  float x0, x1, y0, y1;
};

/// Appends a part of quad (row, column) whose surface continues from the given vertices, one per corner.
void append_fringe(const MeshLayout& layout, const std::vector<float>& depth, int row, int column, const QuadPart& part,
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
void append_cut_quad(const MeshLayout& layout, const Edges& edges, int row, int column, float cut, DepthMesh& mesh) {
  const std::size_t corner00 = static_cast<std::size_t>(row) * layout.columns + column;
  const std::size_t corner10 = corner00 + layout.columns;
  const std::array<float, 4> depth{mesh.depth[corner00], mesh.depth[corner00 + 1], mesh.depth[corner10],
                                   mesh.depth[corner10 + 1]};
  const float farthest = *std::max_element(depth.begin(), depth.end());
  const auto nearer = [&](int corner) { return depth[corner] < (1.0F - cut) * farthest; };
  const auto append = [&](const QuadPart& part, const std::array<int, 4>& from) {
    append_fringe(layout, mesh.depth, row, column, part, from, mesh.fringe);
  };
  if (edges.down[column] != 0 && edges.down[column + 1] != 0) {
    if (nearer(0) || nearer(2)) append({0.0F, 0.5F, 0.0F, 1.0F}, {0, 0, 2, 2});
    if (nearer(1) || nearer(3)) append({0.5F, 1.0F, 0.0F, 1.0F}, {1, 1, 3, 3});
  } else if (edges.above[column] != 0 && edges.below[column] != 0) {
    if (nearer(0) || nearer(1)) append({0.0F, 1.0F, 0.0F, 0.5F}, {0, 1, 0, 1});
    if (nearer(2) || nearer(3)) append({0.0F, 1.0F, 0.5F, 1.0F}, {2, 3, 2, 3});
  } else {
    for (int corner = 0; corner < 4; ++corner) {
      if (!nearer(corner)) continue;
      const int right = corner % 2, below = corner / 2;
      const float x = 0.5F * static_cast<float>(right), y = 0.5F * static_cast<float>(below);
      append({x, x + 0.5F, y, y + 0.5F}, {corner, corner, corner, corner});
    }
  }
}

float blend(float a, float b, int i, int begin, int end) {
  return a + static_cast<float>(i - begin) / static_cast<float>(end - begin) * (b - a);
}

/// Inverse depth of sky with surfaces above and below it: what lies in the plane between them; 0 elsewhere.
std::vector<float> sky_along_columns(const Size& size, std::ptrdiff_t stride, const float* depth) {
  std::vector<float> inverse(size.pixels(), 0.0F);
  std::vector<int> last(static_cast<std::size_t>(size.width), -1);
  for (int row = 0; row < size.height; ++row) {
    const float* here = depth + row * stride;
    for (int column = 0; column < size.width; ++column) {
      if (here[column] >= kFar) continue;
      const int begin = last[static_cast<std::size_t>(column)];
      last[static_cast<std::size_t>(column)] = row;
      if (begin < 0) continue;
      for (int i = begin + 1; i < row; ++i) {
        inverse[static_cast<std::size_t>(i) * size.width + column] =
            blend(1.0F / depth[begin * stride + column], 1.0F / here[column], i, begin, row);
      }
    }
  }
  return inverse;
}

/// Gives a row's sky the farther of the plane between its neighbours in the row and `along_columns`. With a neighbour
/// on one side only that one's depth counts, with none the sky stays at kFar.
void span_sky_row(float* depth, const float* along_columns, int count) {
  int last = -1;
  for (int column = 0; column <= count; ++column) {
    if (column < count && depth[column] >= kFar) continue;
    const bool between = last >= 0 && column < count;
    for (int j = last + 1; j < column; ++j) {
      float inverse = along_columns[j];
      if (between) {
        const float along_row = blend(1.0F / depth[last], 1.0F / depth[column], j, last, column);
        inverse = inverse > 0.0F ? std::min(inverse, along_row) : along_row;
      } else if (inverse == 0.0F && (last >= 0 || column < count)) {
        inverse = 1.0F / depth[last >= 0 ? last : column];
      }
      depth[j] = inverse > 0.0F ? 1.0F / inverse : kFar;
    }
    last = column;
  }
}

/// Gives sky the depth of what frames it: seen through a window it then moves with the window. Sky left at infinity
/// would shine through every gap beside it. The farther of two frames counts, since the nearer may hang in front of
/// the window.
void span_sky(const Size& size, std::ptrdiff_t stride, float* depth) {
  const std::vector<float> along_columns = sky_along_columns(size, stride, depth);
  for (int row = 0; row < size.height; ++row) {
    span_sky_row(depth + row * stride, along_columns.data() + static_cast<std::size_t>(row) * size.width, size.width);
  }
}

/// The image's depths at the vertices.
std::vector<float> vertex_depths(const MeshLayout& layout, const float* depth) {
  const Size& size = layout.view.size;
  const int ring = layout.view.panoramic ? 0 : 1;
  const auto or_far = [](float d) { return d > 0.0F && d < kFar ? d : kFar; };
  std::vector<float> vertices(static_cast<std::size_t>(layout.rows) * layout.columns);
  bool has_sky = false;
  const auto vertex_row = [&](int row) { return vertices.data() + static_cast<std::size_t>(row) * layout.columns; };
  for (int row = 0; row < size.height; ++row) {
    const float* from = depth + static_cast<std::size_t>(row) * size.width;
    float* to = vertex_row(row + ring) + ring;
    std::transform(from, from + size.width, to, or_far);
    has_sky = has_sky || std::find(to, to + size.width, kFar) != to + size.width;
  }
  if (has_sky) span_sky(size, layout.columns, vertex_row(ring) + ring);
  if (ring != 0) {
    std::copy_n(vertex_row(1), layout.columns, vertex_row(0));
    std::copy_n(vertex_row(layout.rows - 2), layout.columns, vertex_row(layout.rows - 1));
  }
  for (int row = 0; row < layout.rows; ++row) {
    float* to = vertex_row(row);
    if (ring != 0) to[0] = to[1];
    to[layout.columns - 1] = ring != 0 ? to[layout.columns - 2] : to[0];
  }
  return vertices;
}

void pad(FringeQuads& fringe) {
  const auto size = static_cast<std::size_t>(padded_lanes(static_cast<int>(fringe.texel.size())));
  for (int corner = 0; corner < 4; ++corner) {
    for (auto* values : {&fringe.ray_x[corner], &fringe.ray_y[corner], &fringe.ray_z[corner], &fringe.depth[corner]}) {
      values->resize(size);
    }
  }
  for (auto* values : {&fringe.begin_x, &fringe.span_x, &fringe.begin_y, &fringe.span_y}) values->resize(size);
  fringe.triangles.resize(size);
  fringe.texel.resize(size);
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
  const auto padded = static_cast<std::size_t>(padded_lanes(columns));
  across.texel.resize(padded);
  across.begin.resize(padded);
  across.span.resize(padded);
}

DepthMesh build_mesh(const MeshLayout& layout, const float* depth, float cut) {
  DepthMesh mesh;
  mesh.depth = vertex_depths(layout, depth);
  const auto stride = static_cast<std::size_t>(padded_lanes(layout.columns));
  mesh.triangles.resize(static_cast<std::size_t>(layout.rows - 1) * stride);
  EdgeFinder finder(layout, mesh.depth, cut);
  const std::vector<std::uint8_t> none(static_cast<std::size_t>(layout.columns));
  Edges edges{none, none, none};
  finder.right(0, edges.below);
  for (int row = 0; row + 1 < layout.rows; ++row) {
    edges.above.swap(edges.below);
    finder.below(row, edges.down);
    finder.right(row + 1, edges.below);
    std::uint8_t* triangles = mesh.triangles.data() + static_cast<std::size_t>(row) * stride;
    const std::uint8_t *above = edges.above.data(), *below = edges.below.data(), *down = edges.down.data();
    for (int j = 0; j + 1 < layout.columns; ++j) {
      triangles[j] = static_cast<std::uint8_t>((above[j] & down[j] & 1) | ((below[j] & down[j + 1] & 1) << 1));
    }
    for (int j = 0; j + 1 < layout.columns; ++j) {
      if (triangles[j] != (kUpperLeft | kLowerRight)) append_cut_quad(layout, edges, row, j, cut, mesh);
    }
  }
  mesh.fringe.count = static_cast<int>(mesh.fringe.texel.size());
  pad(mesh.fringe);
  return mesh;
}

}  // namespace wiw::reproject
