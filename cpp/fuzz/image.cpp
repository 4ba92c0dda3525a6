// SPDX-License-Identifier: Apache-2.0
// An image of a texture: PNG, JPEG, BMP, TGA, WebP; of Basis Universal the header, since Python decodes the rest.
#include <vector>

#include "reading.hpp"
#include "wiw/scene/import/image_file.hpp"

namespace {

using Bytes = std::span<const std::uint8_t>;

wiw::scene::Texture make_gray(Bytes bytes) {
  const wiw::Size size = wiw::scene::image_size(bytes);
  return {"", size, std::vector<std::uint8_t>(4 * size.pixels(), 128), {}};
}

}  // namespace

extern "C" int LLVMFuzzerTestOneInput(const std::uint8_t* data, std::size_t size) {
  const Bytes bytes(data, size);
  try {
    if (wiw::scene::image_size(bytes).pixels() > wiw::fuzz::small_limits().texture_pixels) return 0;
    wiw::scene::decode_image("image", bytes, make_gray);
  } catch (const wiw::Error&) {  // NOLINT(bugprone-empty-catch): refused, by whoever knows the file's name
  }
  return 0;
}
