// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstdint>
#include <vector>

#include "wiw/reproject/view.hpp"

namespace wiw::reproject {

/// Distance that stands for "nothing hit" (sky): far enough not to move with the camera.
constexpr float kFar = 10000.0F;

/// Vertices and texels of the depth mesh of one kind of source image; what does not depend on its content.
/// A panorama's vertices are its pixel centres, the last column joined to the first. A pinhole view has a further ring
/// of vertices on its outer pixel edges, so that the mesh covers the whole image.
struct MeshLayout {
  explicit MeshLayout(const View& view);

  View view;
  int rows = 0;     // of vertices
  int columns = 0;  // of vertices; a panorama's first column is repeated at the end
  RayTable rays;    // per vertex row and column
  // The texel block that a quad reads and the fraction at its left and right (upper and lower) ends, per column (row)
  // of quads.
  struct Axis {
    std::vector<std::uint32_t> texel;
    std::vector<float> begin, span;
  };
  Axis across, down;
};

/// Triangles of a quad with corners 00 01 / 10 11 (row, column).
constexpr std::uint8_t kUpperLeft = 1;   // 00 01 10
constexpr std::uint8_t kLowerRight = 2;  // 11 10 01

/// Quads that are not part of the grid: where the mesh is cut, the nearer surface still reaches half a pixel beyond its
/// last vertices, so objects keep their size and those a pixel wide do not vanish. One array a corner; padded to whole
/// groups of kLanes.
struct FringeQuads {
  int count = 0;
  std::vector<float> ray_x[4], ray_y[4], ray_z[4], depth[4];
  std::vector<std::uint8_t> triangles;
  std::vector<std::uint32_t> texel;  // column | row << 16
  std::vector<float> begin_x, span_x, begin_y, span_y;
};

/// Depth mesh of one image.
struct DepthMesh {
  std::vector<float> depth;             // [rows, columns] of vertices, none missing: see build_mesh
  std::vector<std::uint8_t> triangles;  // [rows - 1, padded_lanes(columns)] of quads: triangles that are surface
  FringeQuads fringe;
};

/// Builds the mesh and cuts it where two neighbouring depths differ by more than the fraction `cut` of the farther
/// one, unless inverse depth goes on in the same slope on either side: on any plane it is linear, so a grazing wall
/// stays whole. Pixels without depth (sky) lie in the plane between their neighbours in the row or in the column,
/// whichever is farther, or at kFar where neither has any.
DepthMesh build_mesh(const MeshLayout& layout, const float* depth, float cut);

}  // namespace wiw::reproject
