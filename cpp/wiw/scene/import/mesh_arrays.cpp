// SPDX-License-Identifier: Apache-2.0
#include "wiw/scene/import/mesh_arrays.hpp"

#include <algorithm>
#include <cmath>

#include "wiw/core/error.hpp"

namespace wiw::scene {
namespace {

template <class Row>
void check_finite(std::span<const Row> rows, const char* what, const std::filesystem::path& path,
                  const std::string& mesh) {
  for (std::size_t i = 0; i < rows.size(); ++i) {
    if (rows[i].allFinite()) continue;
    throw FileError(path.string(), mesh + ": " + what + " " + std::to_string(i) + " is not finite (damaged file)");
  }
}

}  // namespace

void check_positions(std::span<const Eigen::Vector3f> positions, const std::filesystem::path& path,
                     const std::string& mesh) {
  check_finite(positions, "vertex", path, mesh);
}

void check_texture_coordinates(std::span<const Eigen::Vector2f> uv, const std::filesystem::path& path,
                               const std::string& mesh) {
  check_finite(uv, "texture coordinate", path, mesh);
}

bool normalize_normals(std::vector<Eigen::Vector3f>& normals) {
  for (Eigen::Vector3f& normal : normals) {
    const float length = normal.norm();
    if (!std::isfinite(length) || length < 1e-6f) {
      normals.clear();
      return false;
    }
    normal /= length;
  }
  return true;
}

std::uint8_t display_byte(float value, bool linear) {
  const float clamped = value > 0.f ? std::min(value, 1.f) : 0.f;
  return static_cast<std::uint8_t>(std::lround(255.f * (linear ? std::pow(clamped, 1.f / 2.2f) : clamped)));
}

}  // namespace wiw::scene
