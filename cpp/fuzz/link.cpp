// SPDX-License-Identifier: Apache-2.0
// A mesh of a robot's link, whose format is taken from its first bytes. OBJ has a target of its own, with the same
// checks: assimp sets 16 MB to zero for each such file.
#include <string_view>

#include "reading.hpp"
#include "wiw/physics/mesh_file.hpp"

namespace {

std::string name_by(std::string_view bytes) {
  if (bytes.starts_with("ply")) return "m.ply";
  return bytes.starts_with("<") ? "m.dae" : "m.stl";
}

}  // namespace

extern "C" int LLVMFuzzerTestOneInput(const std::uint8_t* data, std::size_t size) {
  static const wiw::fuzz::Folder folder;
  const std::string name = name_by({reinterpret_cast<const char*>(data), size});
  const auto file = folder.write(name, std::span(data, size));
  const Eigen::Vector3d scale(1, 1, -2);
  wiw::fuzz::read_or_refuse(file, [&](const auto& path) { wiw::physics::surface_of_file(path, scale, "hand"); });
  wiw::fuzz::read_or_refuse(file, [&](const auto& path) { wiw::physics::hull_of_file(path, scale, "hand"); });
  return 0;
}
