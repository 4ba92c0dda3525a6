// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <list>
#include <memory>
#include <mutex>
#include <optional>
#include <span>

#include "wiw/panorama/remap.hpp"

namespace wiw::panorama {

/// Cached look-up of perspective views in panoramas of one size. Yaw only moves columns, so all yaws that are whole
/// columns (at W = 1024 every multiple of 22.5 degrees) share one table; other yaws get a table per sub-column
/// remainder, the most recent ones kept. Thread-safe.
class PerspectivePlan {
 public:
  PerspectivePlan(const Size& panorama, const PerspectiveView& view);

  [[nodiscard]] const Size& panorama_size() const { return panorama_; }
  [[nodiscard]] const PerspectiveView& view() const { return view_; }

  /// Columns in [0, W) by which a view turned left by `yaw` radians is moved, if that is a whole number.
  [[nodiscard]] std::optional<int> column_shift(double yaw) const;

  /// One view into `out` [h, w, C], on the calling thread. `shift`: see column_shift.
  void apply(ImageView<const std::uint8_t> panorama, int shift, ImageView<std::uint8_t> out) const;

  /// Every view of every panorama, [B, H, W, C] -> [B, yaws, h, w, C], panoramas spread over the shared threads.
  /// T is uint8, float or (nearest only) uint32.
  template <class T>
  void apply(const T* panoramas, std::size_t count, int channels, std::span<const double> yaws,
             Interpolation interpolation, T* out) const;

 private:
  struct Tables;
  /// A yaw split into whole columns and the table of the remainder.
  struct Lookup {
    std::shared_ptr<Tables> tables;
    int shift;
  };
  [[nodiscard]] Lookup lookup(double yaw) const;
  [[nodiscard]] std::shared_ptr<Tables> tables_for(double extra_columns) const;
  /// `count` panoramas, the first of which is given.
  template <class T>
  void apply_together(ImageView<const T> panorama, std::size_t count, std::span<const Lookup> lookups,
                      Interpolation interpolation, T* out) const;

  Size panorama_;
  PerspectiveView view_;
  Coordinates coordinates_;
  mutable std::mutex mutex_;
  mutable std::list<std::shared_ptr<Tables>> recent_;  // most recently used first
};

}  // namespace wiw::panorama
