// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstddef>
#include <span>

namespace wiw {

/// Height and width in pixels, in the order of array shapes.
struct Size {
  int height = 0;
  int width = 0;
  bool operator==(const Size&) const = default;
  [[nodiscard]] std::size_t pixels() const {
    return static_cast<std::size_t>(height) * static_cast<std::size_t>(width);
  }
};

/// Non-owning view of a densely packed image, row-major [height, width, channels].
template <class T>
struct ImageView {
  T* data = nullptr;
  Size size;
  int channels = 1;

  [[nodiscard]] T* row(int y) const {
    return data +
           static_cast<std::size_t>(y) * static_cast<std::size_t>(size.width) * static_cast<std::size_t>(channels);
  }
  [[nodiscard]] T* at(int y, int x) const {
    return row(y) + static_cast<std::size_t>(x) * static_cast<std::size_t>(channels);
  }
  operator ImageView<const T>() const { return {data, size, channels}; }
};

}  // namespace wiw
