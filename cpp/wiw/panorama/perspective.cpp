// SPDX-License-Identifier: Apache-2.0
#include "wiw/panorama/perspective.hpp"

#include <algorithm>
#include <cmath>
#include <string>
#include <type_traits>

#include "wiw/core/error.hpp"
#include "wiw/core/thread_pool.hpp"

namespace wiw::panorama {

namespace {

constexpr std::size_t kTablesKept = 16;
// Panoramas that share the decoding of a table: more would fall out of the second-level cache.
constexpr std::size_t kTogether = 2;
// Yaws nearer to a whole column than this are that column: 1e-6 of a column is far below any weight's last bit.
constexpr double kWholeColumn = 1e-6;

struct SplitYaw {
  int shift;         // whole columns in [0, width)
  double remainder;  // of a column, in [0, 1)
};

SplitYaw split_yaw(double yaw, int width) {
  if (!std::isfinite(yaw)) throw ArgumentError("yaw_deg: expected a finite angle");
  const double turns = yaw / (2.0 * kPi);
  const double columns = (std::ceil(turns) - turns) * width;  // a left turn looks at smaller columns
  double whole = std::round(columns);
  double remainder = 0.0;
  if (std::abs(columns - whole) > kWholeColumn) {
    whole = std::floor(columns);
    remainder = columns - whole;
  }
  return {static_cast<int>(whole) % width, remainder};
}

}  // namespace

struct PerspectivePlan::Tables {
  double extra_columns = 0.0;
  std::once_flag bilinear_once;
  std::once_flag nearest_once;
  BilinearTable bilinear;
  NearestTable nearest;
};

PerspectivePlan::PerspectivePlan(const Size& panorama, const PerspectiveView& view)
    : panorama_(panorama), view_(view), coordinates_(perspective_coordinates(panorama, view)) {}

std::optional<int> PerspectivePlan::column_shift(double yaw) const {
  const SplitYaw split = split_yaw(yaw, panorama_.width);
  if (split.remainder != 0.0) return std::nullopt;
  return split.shift;
}

PerspectivePlan::Lookup PerspectivePlan::lookup(double yaw) const {
  const SplitYaw split = split_yaw(yaw, panorama_.width);
  return {tables_for(split.remainder), split.shift};
}

std::shared_ptr<PerspectivePlan::Tables> PerspectivePlan::tables_for(double extra_columns) const {
  const std::scoped_lock lock(mutex_);
  const auto found = std::find_if(recent_.begin(), recent_.end(), [&](const auto& tables) {
    return std::abs(tables->extra_columns - extra_columns) < kWholeColumn;
  });
  if (found != recent_.end()) {
    recent_.splice(recent_.begin(), recent_, found);
  } else {
    recent_.push_front(std::make_shared<Tables>());
    recent_.front()->extra_columns = extra_columns;
    if (recent_.size() > kTablesKept) recent_.pop_back();
  }
  return recent_.front();
}

template <class T>
void PerspectivePlan::apply_together(ImageView<const T> panorama, std::size_t count, std::span<const Lookup> lookups,
                                     Interpolation interpolation, T* out) const {
  const std::size_t stride = view_.size.pixels() * static_cast<std::size_t>(panorama.channels);
  // Neighbouring yaws that share tables are resampled together.
  for (std::size_t first = 0; first < lookups.size();) {
    Tables& tables = *lookups[first].tables;
    std::vector<RemapTarget<T>> targets;
    std::size_t next = first;
    for (; next < lookups.size() && lookups[next].tables.get() == &tables; ++next) {
      for (std::size_t image = 0; image < count; ++image) {
        targets.push_back({lookups[next].shift, out + (image * lookups.size() + next) * stride, image});
      }
    }
    first = next;
    if (interpolation == Interpolation::kNearest) {
      std::call_once(tables.nearest_once,
                     [&] { tables.nearest = nearest_panorama_table(panorama_, coordinates_, tables.extra_columns); });
      remap(tables.nearest, panorama, std::span<const RemapTarget<T>>(targets));
      continue;
    }
    if constexpr (!std::is_same_v<T, std::uint32_t>) {
      std::call_once(tables.bilinear_once,
                     [&] { tables.bilinear = bilinear_panorama_table(panorama_, coordinates_, tables.extra_columns); });
      remap(tables.bilinear, panorama, std::span<const RemapTarget<T>>(targets));
    }
  }
}

void PerspectivePlan::apply(ImageView<const std::uint8_t> panorama, int shift, ImageView<std::uint8_t> out) const {
  if (out.size != view_.size || out.channels != panorama.channels || shift < 0 || shift >= panorama_.width) {
    throw ArgumentError(
        "PerspectivePlan: expected an output of the view's size with the panorama's channels and a "
        "shift in [0, W), got shift " +
        std::to_string(shift));
  }
  const Lookup lookup{tables_for(0.0), shift};
  apply_together<std::uint8_t>(panorama, 1, {&lookup, 1}, Interpolation::kBilinear, out.data);
}

template <class T>
void PerspectivePlan::apply(const T* panoramas, std::size_t count, int channels, std::span<const double> yaws,
                            Interpolation interpolation, T* out) const {
  if (std::is_same_v<T, std::uint32_t> && interpolation != Interpolation::kNearest) {
    throw ArgumentError("uint32 images hold ids, which cannot be blended: pass interpolation=\"nearest\"");
  }
  std::vector<Lookup> lookups;
  for (const double yaw : yaws) lookups.push_back(lookup(yaw));
  const auto texels = static_cast<std::size_t>(channels);
  const std::size_t together =
      count >= kTogether * static_cast<std::size_t>(ThreadPool::shared().size()) ? kTogether : 1;
  parallel_for((count + together - 1) / together, [&](std::size_t part) {
    const std::size_t first = part * together;
    const ImageView<const T> panorama{panoramas + first * panorama_.pixels() * texels, panorama_, channels};
    apply_together(panorama, std::min(together, count - first), std::span<const Lookup>(lookups), interpolation,
                   out + first * yaws.size() * view_.size.pixels() * texels);
  });
}

template void PerspectivePlan::apply(const std::uint8_t*, std::size_t, int, std::span<const double>, Interpolation,
                                     std::uint8_t*) const;
template void PerspectivePlan::apply(const float*, std::size_t, int, std::span<const double>, Interpolation,
                                     float*) const;
template void PerspectivePlan::apply(const std::uint32_t*, std::size_t, int, std::span<const double>, Interpolation,
                                     std::uint32_t*) const;

}  // namespace wiw::panorama
