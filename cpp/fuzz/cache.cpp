// SPDX-License-Identifier: Apache-2.0
// A cached scene: arrays and table change apart; builds for fuzzing let checksums pass.
#include "wiw/scene/cache.hpp"

#include "mutation.hpp"
#include "reading.hpp"
#include "wiw/scene/cache/header.hpp"
#include "wiw/scene/describe.hpp"

namespace {

using wiw::scene::cache::CacheHeader;

std::vector<std::string> split(const std::string& bytes) {
  if (bytes.size() < sizeof(CacheHeader)) return {};
  const auto header = wiw::fuzz::number_at<CacheHeader>(bytes, 0);
  if (header.table_offset < sizeof(CacheHeader) || header.table_offset > bytes.size()) return {};
  return {bytes.substr(sizeof(CacheHeader), header.table_offset - sizeof(CacheHeader)),
          bytes.substr(header.table_offset)};
}

std::string join(const std::vector<std::string>& parts) {
  CacheHeader header;
  header.version = wiw::scene::kSceneCacheVersion;
  header.table_offset = sizeof(CacheHeader) + parts[0].size();
  header.file_bytes = header.table_offset + parts[1].size();
  std::string bytes;
  wiw::fuzz::append_number(bytes, header);
  return bytes + parts[0] + parts[1];
}

}  // namespace

wiw::fuzz::Container wiw::fuzz::container() { return {.split = split, .join = join}; }

extern "C" int LLVMFuzzerTestOneInput(const std::uint8_t* data, std::size_t size) {
  static const wiw::fuzz::Folder folder;
  wiw::fuzz::read_or_refuse(folder.write("m.wiwscene", std::span(data, size)), [](const std::filesystem::path& file) {
    const auto scene = wiw::scene::map_scene_cache(file);
    wiw::scene::describe(*scene);
    wiw::scene::world_triangles(*scene);
  });
  return 0;
}
