// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstddef>
#include <cstdint>
#include <filesystem>
#include <new>
#include <string>
#include <vector>

#include "wiw/core/error.hpp"

namespace wiw::scene {

/// Size of a regular, readable file in bytes; throws FileError saying what is wrong otherwise.
std::size_t size_of_file(const std::filesystem::path& path);

/// The first `most` bytes of a file, or all of it; throws FileError if it cannot be read.
std::vector<std::uint8_t> read_file(const std::filesystem::path& path, std::size_t most = SIZE_MAX);

/// What `read` returns. Readers of formats throw the standard library's exceptions at damage that they did not foresee;
/// these become FileErrors that name the file.
template <class Read>
auto read_as_file(const std::filesystem::path& path, const Read& read) {
  try {
    return read();
  } catch (const Error&) {
    throw;
  } catch (const std::bad_alloc&) {
    throw;
  } catch (const std::exception& cause) {
    throw FileError(path.string(), "cannot be read: " + std::string(cause.what()) +
                                       " (damaged file; export it again, or open it in another program to check it)");
  }
}

}  // namespace wiw::scene
