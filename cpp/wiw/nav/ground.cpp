// SPDX-License-Identifier: Apache-2.0
#include "wiw/nav/ground.hpp"

#include <algorithm>
#include <cmath>
#include <limits>
#include <numeric>
#include <optional>

namespace wiw::nav {

namespace {

constexpr double kBelow = 0.45, kAbove = 0.1;  // metres
constexpr float kLeastUpright = 0.3f;          // |y| of a unit normal: slopes of up to 72 degrees
constexpr double kMostCells = 4e6;
// Of triangles in cells: 100 MB, and what a fine mesh needs whose triangles touch a few cells each.
constexpr std::size_t kMostEntries = 25'000'000, kMostEntriesEach = 8;

/// Height of the triangle's plane at (x, z) where that lies in the triangle, edges included.
std::optional<double> height_at(const Eigen::Matrix3f& corners, double x, double z) {
  const Eigen::Vector2d a(corners(0, 0), corners(2, 0)), p(x, z);
  const Eigen::Vector2d u = Eigen::Vector2d(corners(0, 1), corners(2, 1)) - a;
  const Eigen::Vector2d v = Eigen::Vector2d(corners(0, 2), corners(2, 2)) - a;
  const auto cross = [](const Eigen::Vector2d& s, const Eigen::Vector2d& t) { return s.x() * t.y() - s.y() * t.x(); };
  const double area = cross(u, v);
  const double s = cross(p - a, v) / area, t = cross(u, p - a) / area;
  constexpr double kMargin = 1e-6;  // so that no seam lets the agent fall through
  if (!(s >= -kMargin && t >= -kMargin && s + t <= 1 + kMargin)) return std::nullopt;
  return corners(1, 0) + s * (corners(1, 1) - corners(1, 0)) + t * (corners(1, 2) - corners(1, 0));
}

struct StripRange {
  double low = std::numeric_limits<double>::infinity(), high = -std::numeric_limits<double>::infinity();

  void add(double value) {
    low = std::min(low, value);
    high = std::max(high, value);
  }
};

/// The range of x of the triangle where its z lies in a strip; empty (low above high) where it does not reach that.
StripRange range_in_strip(const Eigen::Matrix3f& corners, double from, double to) {
  StripRange range;
  for (int k = 0; k < 3; ++k) {
    const Eigen::Vector2d a(corners(0, k), corners(2, k)), b(corners(0, (k + 1) % 3), corners(2, (k + 1) % 3));
    if (from <= a.y() && a.y() <= to) range.add(a.x());
    for (const double edge : {from, to}) {
      if ((a.y() < edge) != (b.y() < edge)) range.add(a.x() + (edge - a.y()) / (b.y() - a.y()) * (b.x() - a.x()));
    }
  }
  return range;
}

bool level(const Eigen::Matrix3f& corners) {
  const Eigen::Vector3f normal = (corners.col(1) - corners.col(0)).cross(corners.col(2) - corners.col(0));
  return std::abs(normal.y()) > kLeastUpright * normal.norm();  // false for a triangle without area
}

}  // namespace

Ground::Ground(const scene::TriangleSoup& soup) {
  Eigen::AlignedBox2f box;
  for (const auto& triangle : soup.triangles) {
    TriangleCorners corners;
    for (int k = 0; k < 3; ++k) corners.col(k) = soup.vertices[triangle[k]];
    if (!level(corners)) continue;
    triangles_.push_back(corners);
    for (int k = 0; k < 3; ++k) box.extend(Eigen::Vector2f(corners(0, k), corners(2, k)));
  }
  if (triangles_.empty()) return;
  origin_ = box.min();
  const Eigen::Vector2d size = box.max().cast<double>() - box.min().cast<double>();
  // The last bound is for a strip narrower than a cell: its area does not tell how many cells it needs.
  cell_ = std::max({cell_, std::sqrt(size.x() * size.y() / kMostCells), size.maxCoeff() / kMostCells});
  const auto for_cells = [this](const TriangleCorners& corners, auto&& visit) {
    const Eigen::Vector3f low = corners.rowwise().minCoeff(), high = corners.rowwise().maxCoeff();
    // Wider than by what `height_at` allows beyond the edges, and by rounding.
    const double margin = 1e-4 * cell_ + 1e-5 * static_cast<double>((high - low).maxCoeff());
    for (int row = cell_of(0, low.z()).y(), last = cell_of(0, high.z()).y(); row <= last; ++row) {
      const double begin = static_cast<double>(origin_.y()) + row * cell_;
      const StripRange range = range_in_strip(corners, begin - margin, begin + cell_ + margin);
      if (range.low > range.high) continue;
      const int to = cell_of(range.high + margin, 0).x();
      for (int column = cell_of(range.low - margin, 0).x(); column <= to; ++column) visit(slot(column, row));
    }
  };
  // Counting sort: first how many triangles touch each cell, then where they go. Where large triangles lie above each
  // other, each is in all of these cells; larger ones take less memory and more time, and change no height.
  const std::size_t most = kMostEntries + kMostEntriesEach * triangles_.size();
  const auto count_entries = [&] {
    cells_ = (size / cell_).array().floor().cast<int>() + 1;
    first_.assign(static_cast<std::size_t>(cells_.prod()) + 1, 0);
    std::size_t entries = 0;
    for (const TriangleCorners& corners : triangles_) {
      for_cells(corners, [&](std::size_t cell) { ++first_[cell + 1], ++entries; });
      if (entries > most) return false;
    }
    return true;
  };
  while (!count_entries()) cell_ *= 2;
  std::partial_sum(first_.begin(), first_.end(), first_.begin());
  entries_.resize(first_.back());
  std::vector<std::size_t> next(first_.begin(), first_.end() - 1);
  for (std::uint32_t i = 0; i < triangles_.size(); ++i) {
    for_cells(triangles_[i], [&](std::size_t cell) { entries_[next[cell]++] = i; });
  }
}

double Ground::height(const Eigen::Vector3d& point) const {
  if (triangles_.empty() || !point.allFinite()) return point.y();  // a point that is NaN lies in no cell
  const Eigen::Vector2i cell = cell_of(point.x(), point.z());
  const std::size_t at = slot(cell.x(), cell.y());
  std::optional<double> best;
  for (std::size_t i = first_[at]; i < first_[at + 1]; ++i) {
    const auto height = height_at(triangles_[entries_[i]], point.x(), point.z());
    if (!height || *height < point.y() - kBelow || *height > point.y() + kAbove) continue;
    best = std::max(*height, best.value_or(*height));
  }
  return best.value_or(point.y());
}

Eigen::Vector2i Ground::cell_of(double x, double z) const {
  const Eigen::Vector2d offset = (Eigen::Vector2d(x, z) - origin_.cast<double>()) / cell_;
  const Eigen::Array2d last = (cells_.array() - 1).cast<double>();
  return offset.array().floor().max(0.0).min(last).cast<int>();
}

std::size_t Ground::slot(int column, int row) const {
  return static_cast<std::size_t>(row) * static_cast<std::size_t>(cells_.x()) + static_cast<std::size_t>(column);
}

}  // namespace wiw::nav
