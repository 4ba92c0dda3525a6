// SPDX-License-Identifier: Apache-2.0
#include "wiw/scene/import/file.hpp"

#include <algorithm>
#include <fstream>

#include "wiw/core/error.hpp"

namespace wiw::scene {

std::size_t size_of_file(const std::filesystem::path& path) {
  std::error_code error;
  const auto status = std::filesystem::status(path, error);
  if (!std::filesystem::exists(status)) throw FileError(path.string(), "no such file");
  if (!std::filesystem::is_regular_file(status)) throw FileError(path.string(), "is not a regular file");
  const auto size = std::filesystem::file_size(path, error);
  if (error) throw FileError(path.string(), error.message());
  return size;
}

std::vector<std::uint8_t> read_file(const std::filesystem::path& path, std::size_t most) {
  const std::size_t size = std::min(most, size_of_file(path));
  std::vector<std::uint8_t> bytes(size);
  std::ifstream stream(path, std::ios::binary);
  if (!stream.read(reinterpret_cast<char*>(bytes.data()), static_cast<std::streamsize>(size))) {
    throw FileError(path.string(), "cannot be read (check its permissions)");
  }
  return bytes;
}

}  // namespace wiw::scene
