// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <assimp/IOSystem.hpp>
#include <string>

#include "wiw/scene/import.hpp"

namespace wiw::scene {

/// What assimp reads files through: read only, each within the size limit, each noted in the trace. A loader that goes
/// on reading at the end of a file, as some do for ever on truncated ones, is stopped by an exception, which assimp
/// reports as the file's error.
class GuardedIo : public Assimp::IOSystem {
 public:
  explicit GuardedIo(const ImportOptions& options) : options_(options) {}
  bool Exists(const char* file) const override;
  char getOsSeparator() const override { return '/'; }
  Assimp::IOStream* Open(const char* file, const char* mode) override;
  void Close(Assimp::IOStream* stream) override;

 private:
  const ImportOptions& options_;
};

}  // namespace wiw::scene
