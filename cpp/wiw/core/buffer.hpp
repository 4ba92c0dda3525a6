// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstddef>
#include <memory>
#include <span>
#include <utility>
#include <vector>

namespace wiw {

/// Immutable array whose storage is either an owned vector or a region kept alive by someone else (a mapped cache
/// file, a NumPy array). Copies share the storage.
template <class T>
class Buffer {
 public:
  Buffer() = default;
  Buffer(std::vector<T> values)  // NOLINT(google-explicit-constructor): a vector is the usual way to make one
  {
    auto owner = std::make_shared<const std::vector<T>>(std::move(values));
    view_ = {owner->data(), owner->size()};
    owner_ = std::move(owner);
  }
  Buffer(std::shared_ptr<const void> owner, std::span<const T> view) : owner_(std::move(owner)), view_(view) {}

  [[nodiscard]] const T* data() const { return view_.data(); }
  [[nodiscard]] std::size_t size() const { return view_.size(); }
  [[nodiscard]] bool empty() const { return view_.empty(); }
  const T& operator[](std::size_t i) const { return view_[i]; }
  [[nodiscard]] auto begin() const { return view_.begin(); }
  [[nodiscard]] auto end() const { return view_.end(); }
  operator std::span<const T>() const { return view_; }

 private:
  std::shared_ptr<const void> owner_;
  std::span<const T> view_;
};

}  // namespace wiw
