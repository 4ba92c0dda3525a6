// SPDX-License-Identifier: Apache-2.0
#include "wiw/render/cpu/record_order.hpp"

#include <algorithm>

namespace wiw::render::cpu {

namespace {

constexpr std::size_t kFew = std::size_t{1} << 17;  // their records, 8 MB, stay in the caches
constexpr float kFar = 0.02f;                       // of the mesh's extent, from a triangle to the next: in no order

/// Spreads ten bits to every third bit.
std::uint32_t spread_bits(std::uint32_t x) {
  x = (x | (x << 16)) & 0x030000FFu;
  x = (x | (x << 8)) & 0x0300F00Fu;
  x = (x | (x << 4)) & 0x030C30C3u;
  return (x | (x << 2)) & 0x09249249u;
}

/// Position on the Z-order curve through 1024 cells an axis (G. M. Morton, 1966).
std::uint32_t morton_code(const Eigen::Vector3f& at) {
  const auto cell = [](float x) { return static_cast<std::uint32_t>(std::clamp(1024.f * x, 0.f, 1023.f)); };
  return spread_bits(cell(at.x())) | (spread_bits(cell(at.y())) << 1) | (spread_bits(cell(at.z())) << 2);
}

/// Middles of the triangles, relative to the longest side of the box around the mesh.
std::vector<Eigen::Vector3f> relative_middles(const scene::Mesh& mesh) {
  Eigen::AlignedBox3f box;
  for (const Eigen::Vector3f& position : mesh.positions) box.extend(position);
  const float scale = 1.f / std::max(box.sizes().maxCoeff(), 1e-20f);
  std::vector<Eigen::Vector3f> middles;
  middles.reserve(mesh.triangles.size());
  for (const scene::Triangle& t : mesh.triangles) {
    const Eigen::Vector3f sum = mesh.positions[t[0]] + mesh.positions[t[1]] + mesh.positions[t[2]];
    middles.emplace_back((sum / 3.f - box.min()) * scale);
  }
  return middles;
}

bool keeps_neighbours_together(const std::vector<Eigen::Vector3f>& middles) {
  double way = 0.0;
  for (std::size_t t = 1; t < middles.size(); ++t) way += static_cast<double>((middles[t] - middles[t - 1]).norm());
  return way < static_cast<double>(kFar) * static_cast<double>(middles.size());
}

}  // namespace

std::vector<std::uint32_t> spatial_order(const scene::Mesh& mesh) {
  if (mesh.triangles.size() < kFew) return {};
  const std::vector<Eigen::Vector3f> middles = relative_middles(mesh);
  if (keeps_neighbours_together(middles)) return {};
  std::vector<std::uint64_t> keys(middles.size());  // code and triangle
  for (std::size_t t = 0; t < keys.size(); ++t) keys[t] = (std::uint64_t{morton_code(middles[t])} << 32) | t;
  std::sort(keys.begin(), keys.end());
  std::vector<std::uint32_t> places(keys.size());
  for (std::size_t i = 0; i < keys.size(); ++i) places[keys[i] & 0xFFFFFFFFu] = static_cast<std::uint32_t>(i);
  return places;
}

}  // namespace wiw::render::cpu
