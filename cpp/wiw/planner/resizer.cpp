// SPDX-License-Identifier: Apache-2.0
#include "wiw/planner/resizer.hpp"

#include <algorithm>
#include <cstdlib>
#include <numeric>
#include <string>
#include <type_traits>

#include "wiw/core/error.hpp"

namespace wiw::planner {

namespace {

/// Adds one weighted row. Sums of bytes whose weights total at most 257 fit 16 bits, which vectorises twice as wide.
template <class Sum>
void add_row(const std::uint8_t* row, std::uint16_t weight, std::size_t count, Sum* sums) {
  for (std::size_t i = 0; i < count; ++i) sums[i] = static_cast<Sum>(sums[i] + static_cast<Sum>(row[i] * weight));
}

int wrapped(int index, int size) { return ((index % size) + size) % size; }

}  // namespace

Resizer::Resizer(Size from, Size to, Keep keep) : from_(from), to_(to) {
  constexpr int kLargest = 16384;
  for (const int side : {from.height, from.width, to.height, to.width}) {
    if (side < 1 || side > kLargest) {
      throw ArgumentError("resize: expected sides from 1 to 16384 pixels, got " + std::to_string(from.height) + "x" +
                          std::to_string(from.width) + " to " + std::to_string(to.height) + "x" +
                          std::to_string(to.width));
    }
  }
  const bool sphere = keep == Keep::kSphere;
  columns_ = make_axis(from.width, to.width, from.width, to.width, sphere);
  rows_ = sphere ? make_axis(from.height, to.height, from.height, to.height, false)
                 : make_axis(from.height, to.height, from.width, to.width, false);
}

Resizer::AxisTaps Resizer::make_axis(int from, int to, int in, int out, bool wrap) {
  const int common = std::gcd(in, out);
  in /= common;
  out /= common;
  return out <= in ? averages(from, to, in, out) : interpolations(from, to, in, out, wrap);
}

Resizer::AxisTaps Resizer::averages(int from, int to, int in, int out) {
  int twice_first = from * out - to * in;  // where output 0 begins, in units of 1/(2 out) of an input pixel
  if (twice_first % 2 != 0) {
    in *= 2;
    out *= 2;
    twice_first *= 2;
  }
  AxisTaps axis;
  axis.total = static_cast<std::uint32_t>(in);
  // In units of 1/out of an input pixel: output i covers [begin, begin + in), input j [j * out, (j + 1) * out).
  for (int i = 0, begin = twice_first / 2; i < to; ++i, begin += in) {
    axis.begin.push_back(axis.taps.size());
    for (int j = std::max(begin, 0) / out; j < from && j * out < begin + in; ++j) {
      const int overlap = std::min(begin + in, (j + 1) * out) - std::max(begin, j * out);
      axis.taps.push_back({j, static_cast<std::uint16_t>(overlap)});
    }
  }
  axis.begin.push_back(axis.taps.size());
  return axis;
}

Resizer::AxisTaps Resizer::interpolations(int from, int to, int in, int out, bool wrap) {
  AxisTaps axis;
  axis.total = static_cast<std::uint32_t>(2 * out);
  const auto place = [&](int j) { return wrap ? wrapped(j, from) : std::clamp(j, 0, from - 1); };
  for (int i = 0; i < to; ++i) {
    axis.begin.push_back(axis.taps.size());
    // The output's centre in units of 1/(2 out) of an input pixel, counted from the centre of input 0.
    const int centre = (2 * i + 1 - to) * in + (from - 1) * out;
    if (centre < -out || centre >= (2 * from - 1) * out) continue;
    const int below = centre < 0 ? -1 : centre / (2 * out);
    const int weight = centre - below * 2 * out;
    axis.taps.push_back({place(below), static_cast<std::uint16_t>(2 * out - weight)});
    axis.taps.push_back({place(below + 1), static_cast<std::uint16_t>(weight)});
  }
  axis.begin.push_back(axis.taps.size());
  return axis;
}

namespace {

/// Exact weighted means of a row's columns, rounded. `Total` holds 255 times all weights.
template <class Total, class Sum, class Columns>
void average_columns(const Sum* sums, int width, int shift, const Columns& columns, double scale, std::uint8_t* out) {
  using Real = std::conditional_t<sizeof(Total) == 4, float, double>;
  const auto factor = static_cast<Real>(scale);
  for (std::size_t x = 0; x + 1 < columns.begin.size(); ++x) {
    Total total[3] = {0, 0, 0};
    for (std::size_t t = columns.begin[x]; t < columns.begin[x + 1]; ++t) {
      int column = columns.taps[t].index - shift;
      if (column < 0) column += width;
      const Sum* pixel = sums + 3 * static_cast<std::size_t>(column);
      const Total weight = columns.taps[t].weight;
      for (int c = 0; c < 3; ++c) total[c] += weight * pixel[c];
    }
    for (const Total sum : total) *out++ = static_cast<std::uint8_t>(static_cast<Real>(sum) * factor + Real{0.5});
  }
}

template <class Sum, class Total, class Rows, class Columns>
void resize_with(const std::uint8_t* source, Size from, Size to, int shift, const Rows& rows, const Columns& columns,
                 std::uint8_t* out) {
  const std::size_t stride = 3 * static_cast<std::size_t>(from.width);
  const double scale = 1.0 / (static_cast<double>(rows.total) * static_cast<double>(columns.total));
  std::vector<Sum> sums(stride);
  for (std::size_t y = 0; y < static_cast<std::size_t>(to.height); ++y) {
    std::fill(sums.begin(), sums.end(), Sum{0});
    for (std::size_t t = rows.begin[y]; t < rows.begin[y + 1]; ++t) {
      add_row(source + static_cast<std::size_t>(rows.taps[t].index) * stride, rows.taps[t].weight, stride, sums.data());
    }
    average_columns<Total>(sums.data(), from.width, shift, columns, scale, out + 3 * y * to.width);
  }
}

}  // namespace

void Resizer::operator()(const std::uint8_t* source, int shift, std::uint8_t* out) const {
  // Sums below 2^24 are whole numbers in single precision too.
  const std::uint64_t largest = std::uint64_t{255} * rows_.total * columns_.total;
  if (rows_.total <= 257 && largest < 16777216) {
    resize_with<std::uint16_t, std::uint32_t>(source, from_, to_, shift, rows_, columns_, out);
  } else {
    resize_with<std::uint32_t, std::uint64_t>(source, from_, to_, shift, rows_, columns_, out);
  }
}

}  // namespace wiw::planner
