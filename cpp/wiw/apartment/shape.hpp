// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <Eigen/Geometry>
#include <cstdint>
#include <vector>

#include "wiw/apartment/color.hpp"
#include "wiw/scene/triangle.hpp"

namespace wiw::apartment {

using Vec2 = Eigen::Vector2f;
using Vec3 = Eigen::Vector3f;
using MaterialId = std::uint32_t;

/// Triangles of one material. `uv` is in metres, or in whole images for an image material.
struct Submesh {
  MaterialId material = 0;
  std::vector<Vec3> positions, normals;
  std::vector<Vec2> uv;
  std::vector<Rgb> tint;  // multiplies the material's colour
  std::vector<scene::Triangle> triangles;
};

/// Geometry kit: collects primitives in the furniture's own frame (x right, y up, front towards +z, floor at y = 0).
/// Flat faces are cut into cells of at most `edge` metres, since furniture carries its light at the vertices.
class FurnitureShape {
 public:
  /// Moves everything added later.
  void set_frame(const Eigen::Affine3f& frame) { frame_ = frame; }
  [[nodiscard]] const Eigen::Affine3f& frame() const { return frame_; }
  void set_tint(const Rgb& tint) { tint_ = tint; }
  void set_edge(float edge) { edge_ = edge; }

  /// Parallelogram seen from the side that u x v points to.
  void quad(MaterialId material, const Vec3& corner, const Vec3& u, const Vec3& v);
  /// Small quadrangle with corners in order, counter-clockwise as seen.
  void patch(MaterialId material, const Vec3& a, const Vec3& b, const Vec3& c, const Vec3& d);
  /// The same as quad, showing one whole image upright.
  void image(MaterialId material, const Vec3& corner, const Vec3& u, const Vec3& v);
  void box(MaterialId material, const Vec3& low, const Vec3& high);
  /// Box with edges rounded to `radius` and its top swollen by `bulge`: cushions, mattresses, appliances.
  void soft_box(MaterialId material, const Vec3& low, const Vec3& high, float radius, float bulge = 0.f, int steps = 2);
  /// Truncated cone from `base` to `top`, both ends closed.
  void cylinder(MaterialId material, const Vec3& base, const Vec3& top, float base_radius, float top_radius,
                int segments = 12);
  /// Solid of revolution about the vertical through `base`: (radius, height) from bottom to top; a point given twice
  /// makes a sharp edge.
  void lathe(MaterialId material, const Vec3& base, const std::vector<Vec2>& profile, int segments = 20);
  /// Round bar along a path.
  void tube(MaterialId material, const std::vector<Vec3>& path, float radius, int segments = 8);
  void ellipsoid(MaterialId material, const Vec3& center, const Vec3& radii, int segments = 14);
  /// Outline in the xy plane (counter-clockwise, convex), swept from z0 to z1.
  void prism(MaterialId material, const std::vector<Vec2>& outline, float z0, float z1);
  /// Wavy hanging cloth between two heights, folds along x.
  void drape(MaterialId material, const Vec3& low, const Vec3& high, int folds);

  [[nodiscard]] const std::vector<Submesh>& parts() const { return parts_; }
  /// For changes of what surfaces are made of, not of where they are.
  [[nodiscard]] std::vector<Submesh>& parts() { return parts_; }
  [[nodiscard]] Eigen::AlignedBox3f bounds() const;

 private:
  struct Grid {
    int columns = 1, rows = 1;    // cells; (columns + 1) x (rows + 1) vertices, row by row
    std::vector<Vec3> positions;  // in the current frame
    std::vector<Vec3> normals;    // empty: from the surface, smooth
    std::vector<Vec2> uv;
    bool closed = false;  // last column meets the first
  };
  Submesh& part(MaterialId material);
  void add(MaterialId material, const Grid& grid);
  void flat(MaterialId material, const Vec3& corner, const Vec3& u, const Vec3& v, bool whole_image);
  void revolve(MaterialId material, const Vec3& base, const std::vector<Vec2>& profile, int segments);

  float edge_ = 0.2f;
  Eigen::Affine3f frame_ = Eigen::Affine3f::Identity();
  Rgb tint_ = Rgb::Ones();
  std::vector<Submesh> parts_;
  std::uint32_t faces_ = 0;
};

}  // namespace wiw::apartment
