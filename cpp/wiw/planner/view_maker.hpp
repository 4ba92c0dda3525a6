// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstdint>
#include <map>
#include <memory>
#include <mutex>
#include <vector>

#include "wiw/core/intrinsics.hpp"
#include "wiw/panorama/perspective.hpp"
#include "wiw/planner/resizer.hpp"

namespace wiw::planner {

enum class ViewKind {
  kFront,     // one perspective view
  kSurround,  // four: front, left, right, back
  kPanorama,  // the whole sphere
};

/// What an observation is turned into for an agent or a model.
struct ViewSpec {
  ViewKind kind = ViewKind::kFront;
  Size size{.height = 384, .width = 384};
  double hfov = kPi / 2;  // of perspective views
};

enum class FrameKind { kPanorama, kPerspective };

/// Turns panoramas and perspective frames into views. Look-up tables are built once for each size met and kept.
/// Thread-safe.
class ViewMaker {
 public:
  /// Throws ArgumentError for an empty size or a field of view outside (0, 180) degrees.
  explicit ViewMaker(const ViewSpec& spec);

  [[nodiscard]] const ViewSpec& spec() const { return spec_; }
  [[nodiscard]] int count() const { return spec_.kind == ViewKind::kSurround ? 4 : 1; }
  /// Bytes of all views of one observation, [count, height, width, 3].
  [[nodiscard]] std::size_t bytes() const { return 3 * spec_.size.pixels() * static_cast<std::size_t>(count()); }

  /// Views of a panorama after a left turn by `yaw` radians. Throws ArgumentError for a size no panorama has.
  void from_panorama(const std::uint8_t* panorama, Size size, double yaw, std::uint8_t* out) const;
  /// A perspective frame (HFOV 90 degrees, square pixels) as the front view: each pixel shows the frame in its own
  /// direction, and black above and below a frame that is wider than the view. Throws ArgumentError for views that are
  /// not the front in 90 degrees.
  void from_perspective(const std::uint8_t* frame, Size size, std::uint8_t* out) const;
  /// Depth of the first view after a left turn: distances float [H, W] in a panorama become float [height, width],
  /// planar z in perspective views, distances in panoramas. Nearest pixels, since depths do not blend over edges.
  void depth(const float* panorama, Size size, double yaw, float* out) const;

 private:
  [[nodiscard]] const panorama::PerspectivePlan& plan(Size size) const;
  [[nodiscard]] const Resizer& resizer(Size size) const;
  void resize_panorama(const std::uint8_t* panorama, Size size, double yaw, std::uint8_t* out) const;

  ViewSpec spec_;
  std::vector<double> yaws_;
  std::vector<float> planar_;  // planar z per metre of distance, of each pixel
  mutable std::mutex mutex_;
  mutable std::map<std::pair<int, int>, std::unique_ptr<panorama::PerspectivePlan>> plans_;
  mutable std::map<std::pair<int, int>, std::unique_ptr<Resizer>> resizers_;
};

}  // namespace wiw::planner
