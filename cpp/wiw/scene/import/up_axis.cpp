// SPDX-License-Identifier: Apache-2.0
#include "wiw/scene/import/up_axis.hpp"

#include <string_view>

#include "wiw/scene/import/file.hpp"

namespace wiw::scene {
namespace {

/// <asset> is the first child of a COLLADA document, so its head is enough.
UpAxis from_collada_header(const std::filesystem::path& path) {
  const auto bytes = read_file(path, 1 << 16);
  const std::string_view head(reinterpret_cast<const char*>(bytes.data()), bytes.size());
  constexpr std::string_view kTag = "<up_axis>";
  const std::size_t tag = head.find(kTag);
  if (tag == std::string_view::npos) return {'Y', "COLLADA default"};
  const std::size_t value = head.find_first_not_of(" \t\r\n", tag + kTag.size());
  const char axis = value == std::string_view::npos ? 'Y' : head[value];
  return {axis == 'X' || axis == 'Z' ? axis : 'Y', "by file header"};
}

}  // namespace

Eigen::Matrix3f UpAxis::to_y_up() const {
  Eigen::Matrix3f rotation = Eigen::Matrix3f::Identity();
  if (axis == 'Z') rotation << 1, 0, 0, 0, 0, 1, 0, -1, 0;
  if (axis == 'X') rotation << 0, -1, 0, 1, 0, 0, 0, 0, 1;
  return rotation;
}

UpAxis up_axis_of(const std::filesystem::path& path, MeshFormat format, Up up) {
  if (up != Up::kAuto) return {up == Up::kZ ? 'Z' : 'Y', "as asked"};
  if (format == MeshFormat::kDae) return from_collada_header(path);
  const std::string name = path.filename().string();
  if (name.ends_with(".basis.glb") || name.ends_with(".semantic.glb")) return {'Z', "HM3D file layout"};
  if (format == MeshFormat::kGlb || format == MeshFormat::kGltf) return {'Y', "glTF specification"};
  return {'Y', "default, the file does not say"};
}

}  // namespace wiw::scene
