// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstdint>
#include <cstdio>
#include <cstdlib>
#include <filesystem>
#include <fstream>
#include <span>
#include <string>

#include "wiw/core/error.hpp"
#include "wiw/scene/import/limits.hpp"

namespace wiw::fuzz {

/// A folder of its own. libFuzzer ends the process without destructors: whoever sets TMPDIR removes it.
class Folder {
 public:
  Folder() {
    std::string pattern = (std::filesystem::temp_directory_path() / "wiw-fuzz-XXXXXX").string();
    path_ = mkdtemp(pattern.data());
  }

  std::filesystem::path write(const std::string& name, std::span<const std::uint8_t> bytes) const {
    const std::filesystem::path file = path_ / name;
    std::ofstream(file, std::ios::binary)
        .write(reinterpret_cast<const char*>(bytes.data()), static_cast<std::streamsize>(bytes.size()));
    return file;
  }
  std::filesystem::path write(const std::string& name, std::string_view text) const {
    return write(name, std::span(reinterpret_cast<const std::uint8_t*>(text.data()), text.size()));
  }

  void make_folder(const std::string& name) const { std::filesystem::create_directory(path_ / name); }

 private:
  std::filesystem::path path_;
};

/// Calls `read`, which may refuse the file by an error of wiw's own that names it, or one beside it; anything else ends
/// the process.
template <class Read>
void read_or_refuse(const std::filesystem::path& file, const Read& read) {
  try {
    read(file);
  } catch (const Error& error) {
    if (std::string(error.what()).find(file.parent_path().string()) != std::string::npos) return;
    std::fprintf(stderr, "the error names no file: %s\n", error.what());
    std::abort();
  }
}

/// Limits in proportion to files of some kilobytes: what takes more memory than they allow does not keep to them.
inline scene::ImportLimits small_limits() {
  return {.file_bytes = 1 << 20,
          .triangles = 100'000,
          .nodes = 10'000,
          .texture_pixels = 1 << 18,
          .texture_bytes = 1 << 22};
}

}  // namespace wiw::fuzz
