// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <string>

#include "wiw/core/error.hpp"
#include "wiw/core/image.hpp"

namespace wiw::metrics {

template <class T>
void check_pair(const ImageView<const T>& a, const ImageView<const T>& b, int smallest) {
  const auto text = [](const ImageView<const T>& image) {
    return std::to_string(image.size.height) + "x" + std::to_string(image.size.width) + "x" +
           std::to_string(image.channels);
  };
  if (a.size != b.size || a.channels != b.channels) {
    throw ArgumentError("expected two images of one size, got " + text(a) + " and " + text(b));
  }
  if (a.size.height < smallest || a.size.width < smallest || a.channels < 1) {
    throw ArgumentError("expected images of at least " + std::to_string(smallest) + "x" + std::to_string(smallest) +
                        " pixels, got " + text(a));
  }
}

}  // namespace wiw::metrics
