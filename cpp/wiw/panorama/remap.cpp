// SPDX-License-Identifier: Apache-2.0
#include "wiw/panorama/remap.hpp"

#include <algorithm>
#include <string>

#include "wiw/core/error.hpp"
#include "wiw/panorama/remap_kernel.hpp"

namespace wiw::panorama {

namespace {

// Pixels per step through a table: 2048 x 8 bytes of table stay in the first-level cache while every target reads it.
constexpr std::size_t kBlock = 2048;

void remap_run_scalar(const RemapRun& run) { remap_pixels_scalar(run, 0, run.count); }

RemapRunFunction run_function(Isa isa) {
#if defined(__x86_64__)
  if (isa == Isa::kAvx512) return remap_run_avx512;
  if (isa == Isa::kAvx2) return remap_run_avx2;
#endif
  return remap_run_scalar;
}

/// Whether remap_groups_vbmi may be called.
bool groups_run_on(Isa isa) {
#if defined(__x86_64__)
  static const bool supported = __builtin_cpu_supports("avx512vbmi") && __builtin_cpu_supports("avx512vnni");
  return isa == Isa::kAvx512 && supported;
#else
  static_cast<void>(isa);
  return false;
#endif
}

/// The image that a target reads.
template <class T>
ImageView<const T> image_of(ImageView<const T> source, const RemapTarget<T>& target) {
  source.data += target.image * source.size.pixels() * static_cast<std::size_t>(source.channels);
  return source;
}

/// The four texels of a regular block; `below` is the distance to the lower row in texels.
struct Block {
  std::ptrdiff_t first;
  std::ptrdiff_t right;
  std::ptrdiff_t below;
};

Block block_at(std::uint32_t packed, int shift, const Size& source) {
  int column = static_cast<int>(packed & 0xFFFFu) + shift;
  if (column >= source.width) column -= source.width;
  return {static_cast<std::ptrdiff_t>(packed >> 16) * source.width + column,
          column == source.width - 1 ? 1 - source.width : 1, source.height > 1 ? source.width : 0};
}

float lerp(float a, float b, float fraction) { return a + fraction * (b - a); }

std::uint8_t blend(const BilinearTable& table, std::size_t i, const Block& block, const std::uint8_t* texel,
                   std::ptrdiff_t channels) {
  const std::uint32_t fx = table.fraction14[i] & 0xFFFFu;
  const std::uint32_t fy = table.fraction14[i] >> 16;
  const std::uint32_t both = (fx * fy + (1u << (kWeightBits - 1))) >> kWeightBits;
  const std::uint8_t* lower = texel + block.below * channels;
  const std::ptrdiff_t right = block.right * channels;
  const std::uint32_t sum = ((1u << kWeightBits) - fx - fy + both) * texel[0] + (fx - both) * texel[right] +
                            (fy - both) * lower[0] + both * lower[right] + (1u << (kWeightBits - 1));
  return static_cast<std::uint8_t>(sum >> kWeightBits);
}

float blend(const BilinearTable& table, std::size_t i, const Block& block, const float* texel,
            std::ptrdiff_t channels) {
  const float* lower = texel + block.below * channels;
  const std::ptrdiff_t right = block.right * channels;
  const float fx = table.fraction_x[i];
  return lerp(lerp(texel[0], texel[right], fx), lerp(lower[0], lower[right], fx), table.fraction_y[i]);
}

template <class T>
void remap_range(const BilinearTable& table, ImageView<const T> source, const RemapTarget<T>& target, std::size_t begin,
                 std::size_t end) {
  const int channels = source.channels;
  for (std::size_t i = begin; i < end; ++i) {
    const Block block = block_at(table.texel[i], target.shift, table.source);
    const T* texel = source.data + block.first * channels;
    for (int c = 0; c < channels; ++c) {
      target.out[i * static_cast<std::size_t>(channels) + c] = blend(table, i, block, texel + c, channels);
    }
  }
}

std::uint8_t gather(const IrregularPixel& pixel, const std::array<std::uint8_t, 4>& texels) {
  std::uint32_t sum = 1u << (kWeightBits - 1);
  for (std::size_t k = 0; k < 4; ++k) sum += static_cast<std::uint32_t>(pixel.weight14[k]) * texels[k];
  return static_cast<std::uint8_t>(sum >> kWeightBits);
}

float gather(const IrregularPixel& pixel, const std::array<float, 4>& texels) {
  float sum = 0.0F;
  for (std::size_t k = 0; k < 4; ++k) sum += pixel.weight[k] * texels[k];
  return sum;
}

template <class T>
void remap_irregular(const BilinearTable& table, ImageView<const T> source, const RemapTarget<T>& target) {
  for (const IrregularPixel& pixel : table.irregular) {
    for (int c = 0; c < source.channels; ++c) {
      std::array<T, 4> texels;
      for (std::size_t k = 0; k < 4; ++k) {
        texels[k] = source.at(pixel.row[k], (pixel.column[k] + target.shift) % table.source.width)[c];
      }
      target.out[static_cast<std::size_t>(pixel.pixel) * source.channels + c] = gather(pixel, texels);
    }
  }
}

template <class Table, class T>
void check_source(const Table& table, const ImageView<const T>& source) {
  if (source.size == table.source) return;
  throw ArgumentError("resampling: the table was built for " + std::to_string(table.source.height) + " x " +
                      std::to_string(table.source.width) + " images, got " + std::to_string(source.size.height) +
                      " x " + std::to_string(source.size.width));
}

/// Resamples what the table's groups hold and returns how many pixels that is.
std::size_t remap_groups(const BilinearTable& table, ImageView<const std::uint8_t> source,
                         std::span<const RemapTarget<std::uint8_t>> targets, Isa isa) {
#if defined(__x86_64__)
  if (groups_run_on(isa) && !table.groups.empty()) {
    std::vector<RemapStream> streams;
    for (const auto& target : targets) streams.push_back({image_of(source, target).data, target.shift, target.out});
    remap_groups_vbmi({source.size.width, table.texel.data(), table.fraction14.data(), table.groups.data(),
                       table.groups.size(), streams.data(), streams.size()});
    return table.groups.size() * kGroup;
  }
#endif
  return 0;
}

}  // namespace

void remap(const BilinearTable& table, ImageView<const std::uint8_t> source,
           std::span<const RemapTarget<std::uint8_t>> targets, Isa isa) {
  check_source(table, source);
  const bool regular_kernel = source.channels == 3 && source.size.height > 1;
  const RemapRunFunction run = run_function(isa);
  const std::size_t done = regular_kernel ? remap_groups(table, source, targets, isa) : 0;
  for (std::size_t begin = done; begin < table.size(); begin += kBlock) {
    const std::size_t count = std::min(kBlock, table.size() - begin);
    for (const auto& target : targets) {
      const ImageView<const std::uint8_t> image = image_of(source, target);
      if (regular_kernel) {
        run({image.data, image.size.width, target.shift, table.texel.data() + begin, table.fraction14.data() + begin,
             target.out + 3 * begin, count});
      } else {
        remap_range(table, image, target, begin, begin + count);
      }
    }
  }
  for (const auto& target : targets) remap_irregular(table, image_of(source, target), target);
}

void remap(const BilinearTable& table, ImageView<const float> source, std::span<const RemapTarget<float>> targets) {
  check_source(table, source);
  for (const auto& target : targets) {
    remap_range(table, image_of(source, target), target, 0, table.size());
    remap_irregular(table, image_of(source, target), target);
  }
}

void remap_blocks(ImageView<const std::uint8_t> source, std::span<const std::uint32_t> texel,
                  std::span<const std::uint32_t> fraction14, std::uint8_t* out, Isa isa) {
  if (source.channels != 3 || source.size.height < 2) {
    throw ArgumentError("remap_blocks: expected an image of three channels and at least two rows");
  }
  run_function(isa)({source.data, source.size.width, 0, texel.data(), fraction14.data(), out, texel.size()});
}

template <class T>
void remap(const NearestTable& table, ImageView<const T> source, std::span<const RemapTarget<T>> targets) {
  check_source(table, source);
  const auto channels = static_cast<std::size_t>(source.channels);
  for (const auto& target : targets) {
    const ImageView<const T> image = image_of(source, target);
    for (std::size_t i = 0; i < table.size(); ++i) {
      const auto texel = static_cast<std::size_t>(block_at(table.texel[i], target.shift, table.source).first);
      const T* from = image.data + texel * channels;
      T* to = target.out + i * channels;
      for (std::size_t c = 0; c < channels; ++c) to[c] = from[c];
    }
  }
}

template void remap(const NearestTable&, ImageView<const std::uint8_t>, std::span<const RemapTarget<std::uint8_t>>);
template void remap(const NearestTable&, ImageView<const float>, std::span<const RemapTarget<float>>);
template void remap(const NearestTable&, ImageView<const std::uint32_t>, std::span<const RemapTarget<std::uint32_t>>);

}  // namespace wiw::panorama
