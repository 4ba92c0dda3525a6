// SPDX-License-Identifier: Apache-2.0
#include "wiw/scene/import/image_file.hpp"

#include <webp/decode.h>

#include <algorithm>
#include <array>
#include <climits>
#include <cstring>
#include <memory>

#include "wiw/core/error.hpp"
#include "wiw/scene/import/stb_image.hpp"

namespace wiw::scene {
namespace {

using Bytes = std::span<const std::uint8_t>;
constexpr int kChannels = 4;
constexpr std::array<std::uint8_t, 12> kKtx2{0xAB, 'K', 'T', 'X', ' ', '2', '0', 0xBB, '\r', '\n', 0x1A, '\n'};

int length_of(Bytes bytes) {
  if (bytes.size() > INT_MAX) throw Error("the image file is larger than 2 GiB");
  return static_cast<int>(bytes.size());
}

[[noreturn]] void fail() {
  throw Error("cannot be decoded as PNG, JPEG, BMP, TGA or WebP (" + std::string(stbi_failure_reason()) + ")");
}

bool begins_with(Bytes bytes, Bytes begin, std::size_t at = 0) {
  return bytes.size() >= at + begin.size() && std::ranges::equal(bytes.subspan(at, begin.size()), begin);
}

bool is_png(Bytes bytes) {
  constexpr std::array<std::uint8_t, 4> kPng{0x89, 'P', 'N', 'G'};
  return begins_with(bytes, kPng);
}

/// stb takes memory for a chunk before it looks whether the file has as much.
void check_png_chunks(Bytes bytes) {
  constexpr std::size_t kSignature = 8, kChunkHeader = 8, kChecksum = 4;
  constexpr std::array<std::uint8_t, 4> kEnd{'I', 'E', 'N', 'D'};
  for (std::size_t at = kSignature; at + kChunkHeader <= bytes.size();) {
    if (begins_with(bytes, kEnd, at + 4)) return;
    std::size_t length = 0;
    for (const std::uint8_t byte : bytes.subspan(at, 4)) length = length << 8 | byte;
    at += kChunkHeader;
    if (length > bytes.size() - at) throw Error("cannot be decoded as PNG (damaged or truncated)");
    at += length + kChecksum;
  }
}

bool is_ktx2(Bytes bytes) { return begins_with(bytes, kKtx2); }

bool is_webp(Bytes bytes) {
  constexpr std::array<std::uint8_t, 4> kRiff{'R', 'I', 'F', 'F'};
  constexpr std::array<std::uint8_t, 4> kWebp{'W', 'E', 'B', 'P'};
  return begins_with(bytes, kRiff) && begins_with(bytes, kWebp, 8);
}

/// A little-endian number of a header.
template <class T>
int number_at(Bytes bytes, std::size_t at) {
  if (bytes.size() < at + sizeof(T)) throw Error("cannot be decoded as Basis Universal (it ends within its header)");
  T value = 0;
  std::memcpy(&value, bytes.data() + at, sizeof(value));
  if (value > INT_MAX) throw Error("cannot be decoded as Basis Universal (its header is damaged)");
  return static_cast<int>(value);
}

/// KTX2 has its sizes in the header, a `.basis` file in the description of its first slice.
Size basis_size(Bytes bytes) {
  Size size;
  if (is_ktx2(bytes)) {
    size = {number_at<std::uint32_t>(bytes, 24), number_at<std::uint32_t>(bytes, 20)};
  } else {
    const auto slice = static_cast<std::size_t>(number_at<std::uint32_t>(bytes, 65));
    size = {number_at<std::uint16_t>(bytes, slice + 7), number_at<std::uint16_t>(bytes, slice + 5)};
  }
  if (size.width == 0 || size.height == 0) throw Error("cannot be decoded as Basis Universal (it has no pixels)");
  return size;
}

Size webp_size(Bytes bytes) {
  WebPBitstreamFeatures features;
  if (WebPGetFeatures(bytes.data(), bytes.size(), &features) != VP8_STATUS_OK) {
    throw Error("cannot be decoded as WebP (its header is damaged)");
  }
  if (features.has_animation) throw Error("is an animated WebP, which is not drawn");
  return {features.height, features.width};
}

Texture decode_webp(std::string name, Bytes bytes) {
  Size size = webp_size(bytes);
  std::shared_ptr<const std::uint8_t> pixels(
      WebPDecodeRGBA(bytes.data(), bytes.size(), &size.width, &size.height),
      [](const std::uint8_t* data) { WebPFree(const_cast<std::uint8_t*>(data)); });
  if (!pixels) throw Error("cannot be decoded as WebP (damaged or truncated)");
  const Bytes view(pixels.get(), kChannels * size.pixels());
  return {std::move(name), size, Buffer<std::uint8_t>(pixels, view), {}};
}

Texture decode_with(const BasisDecoder& decode_basis, std::string name, Bytes bytes) {
  if (!decode_basis) throw Error("is stored as Basis Universal, which cannot be decoded here");
  const Size expected = basis_size(bytes);
  Texture texture = decode_basis(bytes);
  if (texture.size != expected || texture.rgba.size() != kChannels * expected.pixels()) {
    throw Error("cannot be decoded as Basis Universal (it has another size than its header says)");
  }
  texture.name = std::move(name);
  return texture;
}

}  // namespace

bool is_basis(Bytes bytes) {
  constexpr std::array<std::uint8_t, 2> kBasis{'s', 'B'};
  return is_ktx2(bytes) || begins_with(bytes, kBasis);
}

Size image_size(Bytes bytes) {
  if (is_webp(bytes)) return webp_size(bytes);
  if (is_basis(bytes)) return basis_size(bytes);
  int width = 0;
  int height = 0;
  int channels = 0;
  if (!stbi_info_from_memory(bytes.data(), length_of(bytes), &width, &height, &channels)) fail();
  return {height, width};
}

Texture decode_image(std::string name, Bytes bytes, const BasisDecoder& decode_basis) {
  if (is_webp(bytes)) return decode_webp(std::move(name), bytes);
  if (is_basis(bytes)) return decode_with(decode_basis, std::move(name), bytes);
  if (is_png(bytes)) check_png_chunks(bytes);
  // Buffers double: twice the file, twice 16 bits of RGBA, and what small pictures have beside their pixels.
  bound_stb_buffers(2 * bytes.size() + 16 * image_size(bytes).pixels() + (std::size_t{1} << 20));
  Size size;
  int channels = 0;
  std::shared_ptr<const std::uint8_t> pixels(
      stbi_load_from_memory(bytes.data(), length_of(bytes), &size.width, &size.height, &channels, kChannels),
      [](const std::uint8_t* data) { stbi_image_free(const_cast<std::uint8_t*>(data)); });
  if (!pixels) fail();
  const Bytes view(pixels.get(), kChannels * size.pixels());
  return {std::move(name), size, Buffer<std::uint8_t>(pixels, view), {}};
}

}  // namespace wiw::scene
