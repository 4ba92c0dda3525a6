// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <assimp/IOSystem.hpp>
#include <string>
#include <utility>
#include <vector>

#include "wiw/scene/import.hpp"
#include "wiw/scene/import/gltf_rewrite.hpp"

namespace wiw::scene {

/// What assimp reads files through: read only, each within the size limit, each noted in the trace, `contents` in place
/// of the files of these names. A loader that goes
/// on reading at the end of a file, as some do for ever on truncated ones, is stopped by an exception, which assimp
/// reports as the file's error.
class GuardedIo : public Assimp::IOSystem {
 public:
  GuardedIo(const ImportOptions& options, FileContents contents) : options_(options), contents_(std::move(contents)) {}
  bool Exists(const char* file) const override;
  char getOsSeparator() const override { return '/'; }
  Assimp::IOStream* Open(const char* file, const char* mode) override;
  void Close(Assimp::IOStream* stream) override;

 private:
  [[nodiscard]] const std::vector<std::uint8_t>* content_of(const char* file) const;

  const ImportOptions& options_;
  FileContents contents_;
};

}  // namespace wiw::scene
