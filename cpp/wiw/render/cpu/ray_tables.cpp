// SPDX-License-Identifier: Apache-2.0
#include "wiw/render/cpu/ray_tables.hpp"

#include <algorithm>
#include <cmath>

#include "wiw/render/shading.hpp"

namespace wiw::render::cpu {

namespace {
constexpr int kPadding = 4;  // kernels read whole packets of 4 columns and up to 4 rows

template <class Formula>
std::vector<float> tabulate(int count, const Formula& formula) {
  std::vector<float> values;
  values.reserve(static_cast<std::size_t>(count + kPadding));
  for (int i = 0; i < count + kPadding; ++i) values.push_back(static_cast<float>(formula(i)));
  return values;
}
}  // namespace

RayTables::RayTables(const Camera& camera, int samples) : camera_(camera), samples_(samples) {
  center_ = add_grid(0.0, 0.0);
  const int side = static_cast<int>(std::lround(std::sqrt(samples)));
  for (int j = 0; samples > 1 && j < side; ++j) {
    for (int i = 0; i < side; ++i) {
      grids_.push_back(add_grid(shading::sample_offset(i, j, side), shading::sample_offset(j, side - 1 - i, side)));
    }
  }
}

RayGrid RayTables::add_grid(double dx, double dy) {
  const Size size = camera_.size;
  const auto keep = [this](std::vector<float> values) {
    tables_.push_back(std::move(values));
    return tables_.back().data();
  };
  RayGrid grid{};
  if (camera_.projection == Projection::kPerspective) {
    const double pixel = 1.0 / Intrinsics{size, camera_.hfov}.focal();
    grid.column = keep(tabulate(size.width, [&](int x) { return (x + 0.5 + dx - size.width / 2.0) * pixel; }));
    grid.row = keep(tabulate(size.height, [&](int y) { return -(y + 0.5 + dy - size.height / 2.0) * pixel; }));
    grid.row_spread = keep(tabulate(size.height, [&](int) { return pixel * pixel / samples_; }));
    return grid;
  }
  const auto longitude = [&](int x) { return ((x + 0.5 + dx) / size.width - 0.5) * 2.0 * kPi; };
  const auto latitude = [&](int y) { return (0.5 - (y + 0.5 + dy) / size.height) * kPi; };
  grid.column = keep(tabulate(size.width, [&](int x) { return std::sin(longitude(x)); }));
  grid.column_forward = keep(tabulate(size.width, [&](int x) { return std::cos(longitude(x)); }));
  grid.row = keep(tabulate(size.height, [&](int y) { return std::sin(latitude(y)); }));
  grid.row_cos = keep(tabulate(size.height, [&](int y) { return std::cos(latitude(y)); }));
  grid.row_spread = keep(tabulate(size.height, [&](int y) {
    const double angle = std::max(kPi / size.height, 2.0 * kPi / size.width * std::cos(latitude(y)));
    return angle * angle / samples_;
  }));
  return grid;
}

KernelView RayTables::view(const Pose& T_world_camera) const {
  KernelView view{};
  view.panorama = camera_.projection == Projection::kEquirectangular;
  for (int c = 0; c < 3; ++c) {
    view.origin[c] = static_cast<float>(T_world_camera.translation()[c]);
    view.right[c] = static_cast<float>(T_world_camera.linear()(c, 0));
    view.up[c] = static_cast<float>(T_world_camera.linear()(c, 1));
    view.forward[c] = static_cast<float>(-T_world_camera.linear()(c, 2));
  }
  view.center = center_;
  view.samples = grids_.data();
  view.sample_count = samples_;
  return view;
}

bool RayTables::fits(const Camera& camera) const {
  return camera.projection == camera_.projection && camera.size == camera_.size && camera.hfov == camera_.hfov;
}

}  // namespace wiw::render::cpu
