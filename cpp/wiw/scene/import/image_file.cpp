// SPDX-License-Identifier: Apache-2.0
#include "wiw/scene/import/image_file.hpp"

#include <climits>
#include <memory>

#include "wiw/core/error.hpp"
#include "wiw/scene/import/stb_image.hpp"

namespace wiw::scene {
namespace {

constexpr int kChannels = 4;

int length_of(std::span<const std::uint8_t> bytes) {
  if (bytes.size() > INT_MAX) throw Error("the image file is larger than 2 GiB");
  return static_cast<int>(bytes.size());
}

[[noreturn]] void fail() {
  throw Error("cannot be decoded as PNG, JPEG, BMP or TGA (" + std::string(stbi_failure_reason()) + ")");
}

}  // namespace

Size image_size(std::span<const std::uint8_t> bytes) {
  int width = 0;
  int height = 0;
  int channels = 0;
  if (!stbi_info_from_memory(bytes.data(), length_of(bytes), &width, &height, &channels)) fail();
  return {height, width};
}

Texture decode_image(std::string name, std::span<const std::uint8_t> bytes) {
  Size size;
  int channels = 0;
  std::shared_ptr<const std::uint8_t> pixels(
      stbi_load_from_memory(bytes.data(), length_of(bytes), &size.width, &size.height, &channels, kChannels),
      [](const std::uint8_t* data) { stbi_image_free(const_cast<std::uint8_t*>(data)); });
  if (!pixels) fail();
  const std::span<const std::uint8_t> view(pixels.get(), kChannels * size.pixels());
  return {std::move(name), size, Buffer<std::uint8_t>(pixels, view)};
}

}  // namespace wiw::scene
