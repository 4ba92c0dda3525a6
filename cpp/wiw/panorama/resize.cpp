// SPDX-License-Identifier: Apache-2.0
#include "wiw/panorama/resize.hpp"

#include <algorithm>
#include <cmath>
#include <string>
#include <type_traits>
#include <vector>

#include "wiw/core/error.hpp"

namespace wiw::panorama {

namespace {

/// The source pixels [first, first + weights.size()) that one output pixel covers; the weights add up to 1.
struct Cover {
  int first = 0;
  std::vector<float> weights;
};

std::vector<Cover> covers(int source, int target) {
  std::vector<Cover> result(static_cast<std::size_t>(target));
  for (int i = 0; i < target; ++i) {
    // In units of 1/target source pixels everything is a whole number: [i * source, (i + 1) * source).
    const std::int64_t begin = static_cast<std::int64_t>(i) * source;
    const std::int64_t end = begin + source;
    Cover& cover = result[static_cast<std::size_t>(i)];
    cover.first = static_cast<int>(begin / target);
    for (std::int64_t pixel = cover.first; pixel * target < end; ++pixel) {
      const std::int64_t overlap = std::min(end, (pixel + 1) * target) - std::max(begin, pixel * target);
      cover.weights.push_back(static_cast<float>(static_cast<double>(overlap) / source));
    }
  }
  return result;
}

template <class T>
T finish(float value) {
  if constexpr (std::is_same_v<T, std::uint8_t>) {
    return static_cast<std::uint8_t>(value + 0.5F);
  } else {
    return value;
  }
}

}  // namespace

void check_resize(const Size& source, const Size& size) {
  if (size.height < 1 || size.width < 1 || size.height > source.height || size.width > source.width) {
    throw ArgumentError("resize: expected a size from 1 x 1 to " + std::to_string(source.height) + " x " +
                        std::to_string(source.width) + ", got " + std::to_string(size.height) + " x " +
                        std::to_string(size.width));
  }
}

template <class T>
void resize_area(ImageView<const T> source, const Size& size, T* out) {
  check_resize(source.size, size);
  const std::vector<Cover> rows = covers(source.size.height, size.height);
  const std::vector<Cover> columns = covers(source.size.width, size.width);
  const int channels = source.channels;
  std::vector<float> line(static_cast<std::size_t>(source.size.width) * static_cast<std::size_t>(channels));
  for (const Cover& row : rows) {
    std::fill(line.begin(), line.end(), 0.0F);
    for (std::size_t k = 0; k < row.weights.size(); ++k) {
      const T* from = source.row(row.first + static_cast<int>(k));
      const float weight = row.weights[k];
      for (std::size_t i = 0; i < line.size(); ++i) line[i] += weight * static_cast<float>(from[i]);
    }
    for (const Cover& column : columns) {
      const float* from = line.data() + static_cast<std::ptrdiff_t>(column.first) * channels;
      for (int c = 0; c < channels; ++c) {
        float sum = 0.0F;
        for (std::size_t k = 0; k < column.weights.size(); ++k) {
          sum += column.weights[k] * from[static_cast<std::ptrdiff_t>(k) * channels + c];
        }
        *out++ = finish<T>(sum);
      }
    }
  }
}

template void resize_area(ImageView<const std::uint8_t>, const Size&, std::uint8_t*);
template void resize_area(ImageView<const float>, const Size&, float*);

}  // namespace wiw::panorama
