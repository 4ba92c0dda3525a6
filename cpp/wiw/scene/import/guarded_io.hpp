// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <assimp/IOSystem.hpp>
#include <assimp/Importer.hpp>
#include <cstdint>
#include <string>
#include <vector>

#include "wiw/scene/import.hpp"

namespace wiw::scene {

/// What assimp reads files through: read only, each within the size limit, each noted in the trace. A loader that goes
/// on reading at the end of a file, as some do for ever on truncated ones, is stopped by an exception, which assimp
/// reports as the file's error. OBJ files and their materials get what assimp survives.
class GuardedIo : public Assimp::IOSystem {
 public:
  GuardedIo(const ImportOptions& options, bool is_obj) : options_(options), is_obj_(is_obj) {}
  bool Exists(const char* file) const override;
  char getOsSeparator() const override { return '/'; }
  Assimp::IOStream* Open(const char* file, const char* mode) override;
  void Close(Assimp::IOStream* stream) override;

 private:
  std::vector<std::uint8_t> read_obj(const char* file) const;

  const ImportOptions& options_;
  const bool is_obj_;
  int open_ = 0;
};

/// Throws what has ended the reading of a file if that is an error of wiw's own, which assimp keeps.
void rethrow_own_error(const Assimp::Importer& importer);

}  // namespace wiw::scene
