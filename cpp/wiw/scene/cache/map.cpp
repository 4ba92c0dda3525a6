// SPDX-License-Identifier: Apache-2.0
#include "wiw/core/error.hpp"
#include "wiw/scene/cache.hpp"
#include "wiw/scene/cache/fields.hpp"
#include "wiw/scene/cache/header.hpp"
#include "wiw/scene/cache/mapped_file.hpp"

namespace wiw::scene {
using cache::fields_of;

namespace {

/// Reads the table in the writer's order; arrays become views of the mapping. Everything is checked against the bytes
/// that are there, so that a table that lies cannot lead outside of them.
class CacheReader {
 public:
  CacheReader(std::shared_ptr<const MappedFile> file, std::uint64_t table_offset)
      : file_(std::move(file)),
        arrays_(file_->bytes().first(table_offset)),
        rest_(file_->bytes().subspan(table_offset)) {}

  template <class T>
  void value(T& plain) {
    std::memcpy(&plain, take(sizeof(T)).data(), sizeof(T));
  }
  void value(bool& flag) {
    std::uint8_t byte = 0;
    value(byte);
    flag = byte != 0;
  }
  void text(std::string& text) {
    const auto bytes = take(count(1));
    text.assign(bytes.begin(), bytes.end());
  }
  template <class T>
  void values(std::vector<T>& plain) {
    plain.resize(count(sizeof(T)));
    for (T& item : plain) value(item);
  }
  void texts(std::vector<std::string>& items) {
    items.resize(count(sizeof(std::uint64_t)));
    for (std::string& item : items) text(item);
  }
  void pairs(std::map<std::string, std::string>& items) {
    const std::size_t length = count(2 * sizeof(std::uint64_t));
    for (std::size_t i = 0; i < length; ++i) {
      std::string key;
      text(key);
      text(items[key]);
    }
  }
  template <class T>
  void list(std::vector<T>& items) {
    items.resize(count(sizeof(std::uint64_t)));
    for (T& item : items) fields_of(*this, item);
  }
  template <class T>
  void option(std::optional<T>& item) {
    bool present = false;
    value(present);
    if (present) fields_of(*this, item.emplace());
  }
  template <class T>
  void array(Buffer<T>& buffer) {
    std::uint64_t checksum = 0;
    value(checksum);
    texels(buffer);
    const auto* first = reinterpret_cast<const std::uint8_t*>(buffer.data());
    if (!cache::fits(cache::array_checksum({first, buffer.size() * sizeof(T)}), checksum)) {
      throw Error("the checksum of an array does not fit");
    }
  }
  template <class T>
  void texels(Buffer<T>& buffer) {
    std::uint64_t offset = 0;
    std::uint64_t length = 0;
    value(offset);
    value(length);
    if (offset % cache::kAlignment != 0 || offset > arrays_.size() || length > (arrays_.size() - offset) / sizeof(T)) {
      throw Error("its table names an array outside of the file");
    }
    if (length == 0) return;
    buffer = Buffer<T>(file_, {reinterpret_cast<const T*>(arrays_.data() + offset), length});
  }
  [[nodiscard]] bool at_end() const { return rest_.empty(); }

 private:
  std::span<const std::uint8_t> take(std::size_t size) {
    if (size > rest_.size()) throw Error("its table ends too early");
    const auto bytes = rest_.first(size);
    rest_ = rest_.subspan(size);
    return bytes;
  }
  /// A length that the rest of the table can hold.
  std::size_t count(std::size_t item_bytes) {
    std::uint64_t length = 0;
    value(length);
    if (length > rest_.size() / item_bytes) throw Error("its table names more items than it holds");
    return length;
  }

  std::shared_ptr<const MappedFile> file_;
  std::span<const std::uint8_t> arrays_;
  std::span<const std::uint8_t> rest_;
};

cache::CacheHeader checked_header(std::span<const std::uint8_t> file) {
  cache::CacheHeader header;
  if (file.size() < sizeof(header)) throw Error("it is shorter than its header");
  std::memcpy(&header, file.data(), sizeof(header));
  const cache::CacheHeader expected;
  if (header.magic != expected.magic || header.byte_order != expected.byte_order) throw Error("it is no scene cache");
  if (header.version != kSceneCacheVersion) {
    throw Error("it has version " + std::to_string(header.version) + ", expected " +
                std::to_string(kSceneCacheVersion));
  }
  if (header.file_bytes != file.size() || header.table_offset > file.size() || header.table_offset < sizeof(header)) {
    throw Error("it should have " + std::to_string(header.file_bytes) + " bytes but has " +
                std::to_string(file.size()));
  }
  if (!cache::fits(cache::checksum(header, file.subspan(header.table_offset)), header.checksum))
    throw Error("its checksum does not fit");
  return header;
}

}  // namespace

ScenePtr map_scene_cache(const std::filesystem::path& path) {
  auto file = std::make_shared<const MappedFile>(path);
  try {
    const cache::CacheHeader header = checked_header(file->bytes());
    auto scene = std::make_shared<Scene>();
    CacheReader reader(std::move(file), header.table_offset);
    fields_of(reader, *scene);
    if (!reader.at_end()) throw Error("its table is longer than its scene");
    scene->validate();
    return scene;
  } catch (const Error& error) {
    throw FileError(path.string(), "cannot be used as a scene cache: " + std::string(error.what()));
  }
}

}  // namespace wiw::scene
