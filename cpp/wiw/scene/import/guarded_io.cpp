// SPDX-License-Identifier: Apache-2.0
#include "wiw/scene/import/guarded_io.hpp"

#include <algorithm>
#include <assimp/IOStream.hpp>
#include <cstring>
#include <exception>
#include <stdexcept>

#include "wiw/core/error.hpp"
#include "wiw/scene/import/file.hpp"
#include "wiw/scene/import/obj_text.hpp"

namespace wiw::scene {
namespace {

constexpr int kMostReadsAtEnd = 1000;

class GuardedStream : public Assimp::IOStream {
 public:
  explicit GuardedStream(std::vector<std::uint8_t> bytes) : bytes_(std::move(bytes)) {}

  std::size_t Read(void* buffer, std::size_t size, std::size_t count) override {
    if (size == 0 || count == 0) return 0;
    const std::size_t left = bytes_.size() - position_;
    if (left == 0 && ++reads_at_end_ > kMostReadsAtEnd) throw std::runtime_error("the file ends too early (truncated)");
    const std::size_t whole = std::min(count, left / size);
    std::memcpy(buffer, bytes_.data() + position_, whole * size);
    position_ += whole * size;
    return whole;
  }

  aiReturn Seek(std::size_t offset, aiOrigin origin) override {
    const std::size_t base = origin == aiOrigin_SET ? 0 : (origin == aiOrigin_CUR ? position_ : bytes_.size());
    const std::size_t target = origin == aiOrigin_END ? base - offset : base + offset;
    if (target > bytes_.size()) return aiReturn_FAILURE;
    position_ = target;
    return aiReturn_SUCCESS;
  }

  std::size_t Write(const void*, std::size_t, std::size_t) override { return 0; }
  std::size_t Tell() const override { return position_; }
  std::size_t FileSize() const override { return bytes_.size(); }
  void Flush() override {}

 private:
  std::vector<std::uint8_t> bytes_;
  std::size_t position_ = 0;
  int reads_at_end_ = 0;
};

}  // namespace

bool GuardedIo::Exists(const char* file) const {
  std::error_code ignored;
  const bool there = std::filesystem::is_regular_file(file, ignored);
  if (!there && options_.trace) options_.trace->absent.emplace_back(file);
  return there;
}

Assimp::IOStream* GuardedIo::Open(const char* file, const char* mode) {
  if (std::string_view(mode).find_first_of("wa+") != std::string_view::npos || !Exists(file)) return nullptr;
  if (options_.trace) options_.trace->read.emplace_back(file);
  check_limit(file, "bytes", size_of_file(file), options_.limits.file_bytes, "file_bytes");
  auto bytes = is_obj_ ? read_obj(file) : read_file(file);
  ++open_;
  return new GuardedStream(std::move(bytes));  // NOLINT(cppcoreguidelines-owning-memory): assimp closes it
}

std::vector<std::uint8_t> GuardedIo::read_obj(const char* file) const {
  auto bytes = read_file(file);
  unify_line_ends(file, bytes);
  if (open_ == 0) {
    join_continued_lines(bytes);
    check_library_names(file, bytes);
  } else {  // what is read while the OBJ is read are its materials, be it the same file
    check_obj_materials(file, bytes);
  }
  return bytes;
}

void GuardedIo::Close(Assimp::IOStream* stream) {
  --open_;
  delete stream;  // NOLINT(cppcoreguidelines-owning-memory): made by Open
}

void rethrow_own_error(const Assimp::Importer& importer) {
  if (!importer.GetException()) return;
  try {
    std::rethrow_exception(importer.GetException());
  } catch (const Error&) {
    throw;
  } catch (...) {  // assimp's own, whose text it tells
  }
}

}  // namespace wiw::scene
