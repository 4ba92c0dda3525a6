// SPDX-License-Identifier: Apache-2.0
// A PLY file of labelled faces, as scans have it.
#include "reading.hpp"
#include "wiw/scene/import/ply_surface.hpp"

extern "C" int LLVMFuzzerTestOneInput(const std::uint8_t* data, std::size_t size) {
  static const wiw::fuzz::Folder folder;
  wiw::fuzz::read_or_refuse(folder.write("m.ply", std::span(data, size)), [](const std::filesystem::path& file) {
    wiw::scene::read_ply_surface(file, "object_id", wiw::fuzz::small_limits());
  });
  return 0;
}
