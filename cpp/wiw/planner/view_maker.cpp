// SPDX-License-Identifier: Apache-2.0
#include "wiw/planner/view_maker.hpp"

#include <cmath>
#include <cstring>

#include "wiw/core/error.hpp"
#include "wiw/panorama/roll.hpp"

namespace wiw::planner {

namespace {

panorama::PerspectiveView perspective(const ViewSpec& spec) { return {.size = spec.size, .hfov = spec.hfov}; }

}  // namespace

ViewMaker::ViewMaker(const ViewSpec& spec) : spec_(spec), yaws_{0} {
  if (spec.kind == ViewKind::kPanorama) {
    panorama::check_panorama_size(spec.size);
    return;
  }
  panorama::check_view(perspective(spec));
  if (spec.kind == ViewKind::kSurround) yaws_ = {0, kPi / 2, -kPi / 2, kPi};
  planar_.reserve(spec.size.pixels());
  for (int v = 0; v < spec.size.height; ++v) {
    for (int u = 0; u < spec.size.width; ++u) {
      planar_.push_back(static_cast<float>(1 / panorama::view_ray(u, v, perspective(spec)).norm()));
    }
  }
}

const panorama::PerspectivePlan& ViewMaker::plan(Size size) const {
  const std::scoped_lock lock(mutex_);
  auto& plan = plans_[{size.height, size.width}];
  if (!plan) plan = std::make_unique<panorama::PerspectivePlan>(size, perspective(spec_));
  return *plan;
}

const Resizer& ViewMaker::resizer(Size size) const {
  const std::scoped_lock lock(mutex_);
  const Keep keep = spec_.kind == ViewKind::kPanorama ? Keep::kSphere : Keep::kDirection;
  auto& resizer = resizers_[{size.height, size.width}];
  if (!resizer) resizer = std::make_unique<Resizer>(size, spec_.size, keep);
  return *resizer;
}

void ViewMaker::from_panorama(const std::uint8_t* panorama, Size size, double yaw, std::uint8_t* out) const {
  if (spec_.kind == ViewKind::kPanorama) {
    resize_panorama(panorama, size, yaw, out);
    return;
  }
  std::vector<double> yaws = yaws_;
  for (double& each : yaws) each += yaw;
  plan(size).apply(panorama, 1, 3, yaws, panorama::Interpolation::kBilinear, out);
}

void ViewMaker::resize_panorama(const std::uint8_t* panorama, Size size, double yaw, std::uint8_t* out) const {
  panorama::check_panorama_size(size);
  const ImageView<const std::uint8_t> source{panorama, size, 3};
  if (size == spec_.size) {
    panorama::rotate(source, yaw, panorama::Interpolation::kBilinear, out);
    return;
  }
  const double columns = yaw / (2 * kPi) * size.width;
  const double whole = std::round(columns);
  if (std::abs(columns - whole) < 1e-6) {
    const int shift = static_cast<int>(whole) % size.width;
    resizer(size)(panorama, shift < 0 ? shift + size.width : shift, out);
    return;
  }
  std::vector<std::uint8_t> rolled(3 * size.pixels());
  panorama::rotate(source, yaw, panorama::Interpolation::kBilinear, rolled.data());
  resizer(size)(rolled.data(), 0, out);
}

void ViewMaker::from_perspective(const std::uint8_t* frame, Size size, std::uint8_t* out) const {
  if (spec_.kind != ViewKind::kFront || std::abs(spec_.hfov - kPi / 2) > 1e-9) {
    throw ArgumentError(
        "views: the frames of a perspective model show the front in 90 degrees and nothing else; ask for "
        "the view 'front' with hfov_deg 90, or use a panoramic model");
  }
  if (size == spec_.size) {
    std::memcpy(out, frame, bytes());
  } else {
    resizer(size)(frame, 0, out);
  }
}

void ViewMaker::depth(const float* panorama, Size size, double yaw, float* out) const {
  if (spec_.kind != ViewKind::kPanorama) {
    plan(size).apply(panorama, 1, 1, std::span(&yaw, 1), panorama::Interpolation::kNearest, out);
    for (std::size_t i = 0; i < planar_.size(); ++i) out[i] *= planar_[i];
    return;
  }
  std::vector<float> rolled(size.pixels());
  panorama::rotate(ImageView<const float>{panorama, size, 1}, yaw, panorama::Interpolation::kNearest, rolled.data());
  for (int y = 0; y < spec_.size.height; ++y) {
    const int row = (2 * y + 1) * size.height / (2 * spec_.size.height);
    for (int x = 0; x < spec_.size.width; ++x) {
      const int column = (2 * x + 1) * size.width / (2 * spec_.size.width);
      *out++ = rolled[static_cast<std::size_t>(row) * static_cast<std::size_t>(size.width) +
                      static_cast<std::size_t>(column)];
    }
  }
}

}  // namespace wiw::planner
