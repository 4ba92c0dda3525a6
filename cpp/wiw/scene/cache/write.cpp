// SPDX-License-Identifier: Apache-2.0
#include <fcntl.h>
#include <unistd.h>

#include <atomic>
#include <fstream>

#include "wiw/core/error.hpp"
#include "wiw/scene/cache.hpp"
#include "wiw/scene/cache/fields.hpp"
#include "wiw/scene/cache/header.hpp"

namespace wiw::scene {
using cache::fields_of;

namespace {

std::span<const std::uint8_t> as_bytes(const void* data, std::size_t size) {
  return {static_cast<const std::uint8_t*>(data), size};
}

/// Puts arrays into the file at once and everything else into the table.
class Writer {
 public:
  explicit Writer(std::ofstream& stream) : stream_(stream), position_(sizeof(cache::CacheHeader)) {}

  template <class T>
  void value(const T& plain) {
    const auto bytes = as_bytes(&plain, sizeof(T));
    table_.insert(table_.end(), bytes.begin(), bytes.end());
  }
  void text(const std::string& text) {
    value(std::uint64_t{text.size()});
    table_.insert(table_.end(), text.begin(), text.end());
  }
  template <class T>
  void values(const std::vector<T>& plain) {
    value(std::uint64_t{plain.size()});
    for (const T& item : plain) value(item);
  }
  void texts(const std::vector<std::string>& items) {
    value(std::uint64_t{items.size()});
    for (const std::string& item : items) text(item);
  }
  void pairs(const std::map<std::string, std::string>& items) {
    value(std::uint64_t{items.size()});
    for (const auto& [key, item] : items) {
      text(key);
      text(item);
    }
  }
  template <class T>
  void list(const std::vector<T>& items) {
    value(std::uint64_t{items.size()});
    for (const T& item : items) fields_of(*this, item);
  }
  template <class T>
  void option(const std::optional<T>& item) {
    value(item.has_value());
    if (item) fields_of(*this, *item);
  }
  template <class T>
  void array(const Buffer<T>& buffer) {
    value(cache::array_checksum(as_bytes(buffer.data(), buffer.size() * sizeof(T))));
    texels(buffer);
  }
  template <class T>
  void texels(const Buffer<T>& buffer) {
    align();
    value(position_);
    value(std::uint64_t{buffer.size()});
    put(as_bytes(buffer.data(), buffer.size() * sizeof(T)));
  }

  /// Appends the table and fills in the header.
  void finish() {
    align();
    cache::CacheHeader header;
    header.version = kSceneCacheVersion;
    header.table_offset = position_;
    header.file_bytes = position_ + table_.size();
    header.checksum = cache::checksum(header, table_);
    put(table_);
    stream_.seekp(0);
    stream_.write(reinterpret_cast<const char*>(&header), sizeof(header));
    stream_.close();
  }

  void begin() {
    const cache::CacheHeader empty{};
    stream_.write(reinterpret_cast<const char*>(&empty), sizeof(empty));
  }

 private:
  void put(std::span<const std::uint8_t> bytes) {
    stream_.write(reinterpret_cast<const char*>(bytes.data()), static_cast<std::streamsize>(bytes.size()));
    position_ += bytes.size();
  }
  void align() {
    constexpr std::array<std::uint8_t, cache::kAlignment> kZeros{};
    put(std::span(kZeros).first((cache::kAlignment - position_ % cache::kAlignment) % cache::kAlignment));
  }

  std::ofstream& stream_;
  std::uint64_t position_;
  std::vector<std::uint8_t> table_;
};

/// A name beside `path` that no other writer uses. Machines and containers that share the folder may have processes of
/// the same number, hence the random bits.
std::filesystem::path draft_of(const std::filesystem::path& path) {
  static std::atomic<unsigned> count = 0;
  std::uint64_t random = 0;
  const bool drawn = getentropy(&random, sizeof(random)) == 0;
  std::filesystem::path draft = path;
  draft += '.';
  draft += std::to_string(getpid());
  draft += '-';
  draft += std::to_string(count++);
  if (drawn) draft += '-' + std::to_string(random);
  draft += ".tmp";
  return draft;
}

/// Waits until a file's bytes, or a folder's names, are on the disk.
bool sync_to_disk(const std::filesystem::path& path) {
  const int file = open(path.c_str(), O_RDONLY | O_CLOEXEC);
  if (file < 0) return false;
  const bool done = fsync(file) == 0;
  close(file);
  return done;
}

}  // namespace

void write_scene_cache(const Scene& scene, const std::filesystem::path& path) {
  const std::filesystem::path draft = draft_of(path);
  std::ofstream stream(draft, std::ios::binary | std::ios::trunc);
  if (!stream) throw FileError(draft.string(), "cannot be created (check that the folder exists and is writable)");
  Writer writer(stream);
  writer.begin();
  fields_of(writer, scene);
  writer.finish();
  std::error_code error;
  const bool complete = stream && sync_to_disk(draft);  // else a power cut could leave the name without the bytes
  if (complete) std::filesystem::rename(draft, path, error);
  if (!complete || error) {
    std::error_code ignored;
    std::filesystem::remove(draft, ignored);
    throw FileError(path.string(),
                    "cannot be written (" + (error ? error.message() : std::string("is the disk full?")) + ")");
  }
  sync_to_disk(path.has_parent_path() ? path.parent_path() : ".");  // not every file system can: the name may come late
}

}  // namespace wiw::scene
