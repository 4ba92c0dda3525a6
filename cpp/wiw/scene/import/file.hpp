// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstddef>
#include <cstdint>
#include <filesystem>
#include <vector>

namespace wiw {

/// Size of a regular, readable file in bytes; throws FileError saying what is wrong otherwise.
std::size_t size_of_file(const std::filesystem::path& path);

/// The first `most` bytes of a file, or all of it; throws FileError if it cannot be read.
std::vector<std::uint8_t> read_file(const std::filesystem::path& path, std::size_t most = SIZE_MAX);

}  // namespace wiw
