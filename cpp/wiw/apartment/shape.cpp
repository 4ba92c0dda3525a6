// SPDX-License-Identifier: Apache-2.0
#include "wiw/apartment/shape.hpp"

#include <algorithm>
#include <array>
#include <cmath>

namespace wiw::apartment {

namespace {

constexpr float kTurn = 6.2831853f;

int cells(float length, float edge) { return std::max(1, static_cast<int>(std::ceil(length / edge - 0.05f))); }

/// Smooth normals of a grid of points, seen from the side that (along a row) x (along a column) points to.
std::vector<Vec3> grid_normals(const std::vector<Vec3>& points, int columns, int rows, bool closed) {
  const auto at = [&](int r, int c) -> const Vec3& { return points[static_cast<std::size_t>(r * (columns + 1) + c)]; };
  std::vector<Vec3> normals;
  normals.reserve(points.size());
  for (int r = 0; r <= rows; ++r) {
    for (int c = 0; c <= columns; ++c) {
      const int before = c > 0 ? c - 1 : (closed ? columns - 1 : 0);
      const int after = c < columns ? c + 1 : (closed ? 1 : columns);
      Vec3 along = at(r, after) - at(r, before);
      if (along.squaredNorm() < 1e-12f) {  // a pole: take the direction from the row beside it
        const int beside = r > 0 ? r - 1 : r + 1;
        along = at(beside, after) - at(beside, before);
      }
      const Vec3 across = at(std::min(r + 1, rows), c) - at(std::max(r - 1, 0), c);
      const Vec3 normal = along.cross(across);
      normals.push_back(normal.squaredNorm() > 1e-20f ? Vec3(normal.normalized()) : Vec3(0, 1, 0));
    }
  }
  return normals;
}

}  // namespace

Submesh& FurnitureShape::part(MaterialId material) {
  for (Submesh& candidate : parts_) {
    if (candidate.material == material) return candidate;
  }
  parts_.push_back({material, {}, {}, {}, {}, {}});
  return parts_.back();
}

void FurnitureShape::add(MaterialId material, const Grid& grid) {
  Submesh& out = part(material);
  const auto base = static_cast<std::uint32_t>(out.positions.size());
  const std::vector<Vec3> normals =
      grid.normals.empty() ? grid_normals(grid.positions, grid.columns, grid.rows, grid.closed) : grid.normals;
  for (std::size_t i = 0; i < grid.positions.size(); ++i) {
    out.positions.push_back(frame_ * grid.positions[i]);
    out.normals.push_back((frame_.linear() * normals[i]).normalized());
    out.uv.push_back(grid.uv[i]);
    out.tint.push_back(tint_);
  }
  const auto stride = static_cast<std::uint32_t>(grid.columns + 1);
  for (std::uint32_t r = 0; r < static_cast<std::uint32_t>(grid.rows); ++r) {
    for (std::uint32_t c = 0; c + 1 < stride; ++c) {
      const std::uint32_t a = base + r * stride + c, b = a + 1, d = a + stride, e = d + 1;
      const auto same = [&](std::uint32_t p, std::uint32_t q) {
        return (out.positions[p] - out.positions[q]).squaredNorm() < 1e-12f;
      };
      if (!same(a, b)) out.triangles.emplace_back(a, b, e);
      if (!same(d, e)) out.triangles.emplace_back(a, e, d);
    }
  }
}

void FurnitureShape::flat(MaterialId material, const Vec3& corner, const Vec3& u, const Vec3& v, bool whole_image) {
  Grid grid;
  const float lu = u.norm(), lv = v.norm();
  grid.columns = cells(lu, edge_);
  grid.rows = cells(lv, edge_);
  // Golden-ratio offsets: neighbouring boards of one material show different stretches of its grain.
  const float offset = 1.618034f * static_cast<float>(++faces_ % 64u);
  for (int r = 0; r <= grid.rows; ++r) {
    for (int c = 0; c <= grid.columns; ++c) {
      const float s = static_cast<float>(c) / static_cast<float>(grid.columns);
      const float t = static_cast<float>(r) / static_cast<float>(grid.rows);
      grid.positions.emplace_back(corner + s * u + t * v);
      if (whole_image) {
        grid.uv.emplace_back(s, 1.f - t);
      } else {
        grid.uv.push_back(lu >= lv ? Vec2(offset + s * lu, offset + t * lv) : Vec2(offset + t * lv, offset + s * lu));
      }
    }
  }
  grid.normals.assign(grid.positions.size(), u.cross(v).normalized());
  add(material, grid);
}

void FurnitureShape::quad(MaterialId material, const Vec3& corner, const Vec3& u, const Vec3& v) {
  flat(material, corner, u, v, false);
}
void FurnitureShape::image(MaterialId material, const Vec3& corner, const Vec3& u, const Vec3& v) {
  flat(material, corner, u, v, true);
}

void FurnitureShape::patch(MaterialId material, const Vec3& a, const Vec3& b, const Vec3& c, const Vec3& d) {
  const Vec3 normal = (c - a).cross(d - b);
  if (normal.squaredNorm() < 1e-16f) return;
  Grid grid;
  grid.positions = {a, b, d, c};
  grid.normals.assign(4, normal.normalized());
  for (const Vec3& p : grid.positions)
    grid.uv.emplace_back((p - a).dot((b - a).normalized()), (p - a).dot((d - a).normalized()));
  add(material, grid);
}

void FurnitureShape::box(MaterialId material, const Vec3& low, const Vec3& high) {
  const Vec3 d = high - low;
  const Vec3 x(d.x(), 0, 0), y(0, d.y(), 0), z(0, 0, d.z());
  quad(material, low + z, x, y);
  quad(material, low + x, -x, y);
  quad(material, low + x + z, -z, y);
  quad(material, low, z, y);
  quad(material, low + y + z, x, -z);
  quad(material, low, x, z);
}

void FurnitureShape::soft_box(MaterialId material, const Vec3& low, const Vec3& high, float radius, float bulge,
                              int steps) {
  const float r = std::min(radius, 0.499f * (high - low).minCoeff());
  const Vec3 inner_low = low.array() + r, inner_high = high.array() - r;
  // Coordinates of the grid lines of an axis before rounding: quarter circles at both ends, even cells between.
  const auto lines = [&](int axis) {
    const int count = cells(inner_high[axis] - inner_low[axis], bulge > 0.f ? std::min(edge_, 0.12f) : edge_);
    std::vector<float> values;
    values.reserve(static_cast<std::size_t>(count + 2 * steps + 1));
    for (int i = 0; i < steps; ++i)
      values.push_back(inner_low[axis] -
                       r * std::tan(kTurn / 8 * static_cast<float>(steps - i) / static_cast<float>(steps)));
    for (int i = 0; i <= count; ++i)
      values.push_back(inner_low[axis] +
                       (inner_high[axis] - inner_low[axis]) * static_cast<float>(i) / static_cast<float>(count));
    for (int i = 1; i <= steps; ++i)
      values.push_back(inner_high[axis] + r * std::tan(kTurn / 8 * static_cast<float>(i) / static_cast<float>(steps)));
    return values;
  };
  const std::array<std::array<int, 3>, 6> kFaces{
      {{0, 1, 2}, {1, 0, 2}, {1, 2, 0}, {2, 1, 0}, {2, 0, 1}, {0, 2, 1}}};  // u, v, normal
  for (std::size_t face = 0; face < 6; ++face) {
    const auto [u, v, w] = kFaces[face];
    const bool positive = face % 2 == 0;  // even faces have u x v = +w
    const std::vector<float> us = lines(u), vs = lines(v);
    Grid grid;
    grid.columns = static_cast<int>(us.size()) - 1;
    grid.rows = static_cast<int>(vs.size()) - 1;
    for (const float pv : vs) {
      for (const float pu : us) {
        Vec3 p;
        p[u] = pu, p[v] = pv, p[w] = positive ? high[w] : low[w];
        const Vec3 core = p.cwiseMax(inner_low).cwiseMin(inner_high);
        const Vec3 normal = (p - core).normalized();
        Vec3 q = core + r * normal;
        const Vec3 t = ((q - low).array() / (high - low).array().max(1e-6f) * 2.f - 1.f).matrix();
        q.y() += bulge * std::max(0.f, t.y()) * (1.f - t.x() * t.x()) * (1.f - t.z() * t.z());
        grid.positions.push_back(q);
        if (bulge <= 0.f) grid.normals.push_back(normal);
        grid.uv.emplace_back(pu, pv);
      }
    }
    add(material, grid);
  }
}

void FurnitureShape::revolve(MaterialId material, const Vec3& base, const std::vector<Vec2>& profile, int segments) {
  Grid grid;
  grid.columns = segments;
  grid.rows = static_cast<int>(profile.size()) - 1;
  grid.closed = true;
  float along = 0.f;
  for (std::size_t i = 0; i < profile.size(); ++i) {
    if (i > 0) along += (profile[i] - profile[i - 1]).norm();
    for (int s = 0; s <= segments; ++s) {
      const float turn = static_cast<float>(s % segments) / static_cast<float>(segments) * kTurn;
      grid.positions.emplace_back(
          base + Vec3(profile[i].x() * std::sin(turn), profile[i].y(), profile[i].x() * std::cos(turn)));
      grid.uv.emplace_back(
          kTurn * std::max(profile[i].x(), 0.02f) * static_cast<float>(s) / static_cast<float>(segments), along);
    }
  }
  add(material, grid);
}

void FurnitureShape::lathe(MaterialId material, const Vec3& base, const std::vector<Vec2>& profile, int segments) {
  std::vector<Vec2> run;
  for (const Vec2& point : profile) {
    if (!run.empty() && (run.back() - point).norm() < 1e-6f) {
      if (run.size() > 1) revolve(material, base, run, segments);
      run.clear();
    }
    run.push_back(point);
  }
  if (run.size() > 1) revolve(material, base, run, segments);
}

void FurnitureShape::cylinder(MaterialId material, const Vec3& base, const Vec3& top, float base_radius,
                              float top_radius, int segments) {
  const Vec3 axis = top - base;
  const Eigen::Affine3f outer = frame_;
  Eigen::Affine3f turn = Eigen::Affine3f::Identity();
  turn.translate(base);
  turn.rotate(Eigen::Quaternionf::FromTwoVectors(Vec3::UnitY(), axis));
  frame_ = outer * turn;
  const float h = axis.norm();
  lathe(material, Vec3::Zero(), {{0, 0}, {base_radius, 0}, {base_radius, 0}, {top_radius, h}, {top_radius, h}, {0, h}},
        segments);
  frame_ = outer;
}

void FurnitureShape::tube(MaterialId material, const std::vector<Vec3>& path, float radius, int segments) {
  Grid grid;
  grid.columns = segments;
  grid.rows = static_cast<int>(path.size()) - 1;
  grid.closed = true;
  Vec3 side = Vec3::Zero();
  float along = 0.f;
  for (std::size_t i = 0; i < path.size(); ++i) {
    const Vec3 forward = (path[std::min(i + 1, path.size() - 1)] - path[i > 0 ? i - 1 : 0]).normalized();
    if (i == 0) side = forward.unitOrthogonal();
    side = (side - side.dot(forward) * forward).normalized();
    const Vec3 other = side.cross(forward);
    if (i > 0) along += (path[i] - path[i - 1]).norm();
    for (int s = 0; s <= segments; ++s) {
      const float turn = static_cast<float>(s % segments) / static_cast<float>(segments) * kTurn;
      grid.positions.emplace_back(path[i] + radius * (std::cos(turn) * side + std::sin(turn) * other));
      grid.uv.emplace_back(along, radius * kTurn * static_cast<float>(s) / static_cast<float>(segments));
    }
  }
  // (along the ring) x (along the path) must point outwards.
  const Vec3 ring = grid.positions[1] - grid.positions[0];
  const Vec3 step = grid.positions[static_cast<std::size_t>(segments) + 1] - grid.positions[0];
  if (ring.cross(step).dot(grid.positions[0] - path[0]) < 0.f) {
    const auto stride = static_cast<std::ptrdiff_t>(segments) + 1;
    for (auto row = grid.positions.begin(); row != grid.positions.end(); row += stride) std::reverse(row, row + stride);
  }
  add(material, grid);
}

void FurnitureShape::ellipsoid(MaterialId material, const Vec3& center, const Vec3& radii, int segments) {
  Grid grid;
  grid.columns = segments;
  grid.rows = segments / 2;
  grid.closed = true;
  for (int r = 0; r <= grid.rows; ++r) {
    const float lat = (static_cast<float>(r) / static_cast<float>(grid.rows) - 0.5f) * kTurn / 2;
    for (int s = 0; s <= segments; ++s) {
      const float lon = static_cast<float>(s % segments) / static_cast<float>(segments) * kTurn;
      const Vec3 unit(std::cos(lat) * std::sin(lon), std::sin(lat), std::cos(lat) * std::cos(lon));
      grid.positions.emplace_back(center + radii.cwiseProduct(unit));
      grid.normals.emplace_back(unit.cwiseQuotient(radii).normalized());
      grid.uv.emplace_back(radii.x() * lon, radii.y() * lat);
    }
  }
  add(material, grid);
}

void FurnitureShape::prism(MaterialId material, const std::vector<Vec2>& outline, float z0, float z1) {
  const auto at = [&](std::size_t i, float z) {
    return Vec3(outline[i % outline.size()].x(), outline[i % outline.size()].y(), z);
  };
  for (std::size_t i = 0; i < outline.size(); ++i) {
    const Vec3 along = at(i + 1, z1) - at(i, z1);
    if (along.squaredNorm() > 1e-10f) quad(material, at(i, z0), along, Vec3(0, 0, z1 - z0));
  }
  for (const bool front : {true, false}) {
    Submesh& out = part(material);
    const auto base = static_cast<std::uint32_t>(out.positions.size());
    for (std::size_t i = 0; i < outline.size(); ++i) {
      out.positions.emplace_back(frame_ * at(i, front ? z1 : z0));
      out.normals.emplace_back((frame_.linear() * Vec3(0, 0, front ? 1.f : -1.f)).normalized());
      out.uv.push_back(outline[i]);
      out.tint.push_back(tint_);
    }
    for (std::uint32_t i = 1; i + 1 < outline.size(); ++i) {
      if (front)
        out.triangles.emplace_back(base, base + i, base + i + 1);
      else
        out.triangles.emplace_back(base, base + i + 1, base + i);
    }
  }
}

void FurnitureShape::drape(MaterialId material, const Vec3& low, const Vec3& high, int folds) {
  Grid grid;
  grid.columns = folds * 6;
  grid.rows = cells(high.y() - low.y(), 0.3f);
  for (int r = 0; r <= grid.rows; ++r) {
    for (int c = 0; c <= grid.columns; ++c) {
      const float s = static_cast<float>(c) / static_cast<float>(grid.columns);
      const float t = static_cast<float>(r) / static_cast<float>(grid.rows);
      const float wave = 0.5f + 0.5f * std::sin(kTurn * static_cast<float>(folds) * s + 0.5f * std::sin(5.f * t));
      const float z = low.z() + (high.z() - low.z()) * (0.08f + 0.9f * wave * (1.f - 0.45f * t));
      grid.positions.emplace_back(low.x() + (high.x() - low.x()) * s, low.y() + (high.y() - low.y()) * t, z);
      grid.uv.emplace_back(1.6f * (high.x() - low.x()) * s, (high.y() - low.y()) * t);
    }
  }
  add(material, grid);
}

Eigen::AlignedBox3f FurnitureShape::bounds() const {
  Eigen::AlignedBox3f box;
  for (const Submesh& part : parts_) {
    for (const Vec3& position : part.positions) box.extend(position);
  }
  return box;
}

}  // namespace wiw::apartment
