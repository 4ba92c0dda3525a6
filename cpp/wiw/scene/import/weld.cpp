// SPDX-License-Identifier: Apache-2.0
#include "wiw/scene/import/weld.hpp"

#include <array>
#include <bit>
#include <unordered_map>
#include <vector>

namespace wiw::scene {
namespace {

/// Position, normal, texture coordinate and colour as bits.
using Key = std::array<std::uint32_t, 9>;

struct KeyHash {
  std::size_t operator()(const Key& key) const {
    std::uint64_t hash = 0x9E3779B97F4A7C15ULL;
    for (const std::uint32_t word : key) hash = std::rotl(hash ^ word, 27) * 0xBF58476D1CE4E5B9ULL;
    return hash ^ (hash >> 32);
  }
};

std::uint32_t bits(float value) { return std::bit_cast<std::uint32_t>(value + 0.f); }  // -0 becomes 0

Key key_of(const Mesh& mesh, std::size_t i) {
  Key key{};
  for (int axis = 0; axis < 3; ++axis) key[static_cast<std::size_t>(axis)] = bits(mesh.positions[i][axis]);
  if (!mesh.normals.empty()) {
    for (int axis = 0; axis < 3; ++axis) key[static_cast<std::size_t>(3 + axis)] = bits(mesh.normals[i][axis]);
  }
  if (!mesh.uv.empty()) {
    key[6] = bits(mesh.uv[i].x());
    key[7] = bits(mesh.uv[i].y());
  }
  if (!mesh.colors.empty())
    key[8] = std::bit_cast<std::uint32_t>(
        std::array{mesh.colors[i][0], mesh.colors[i][1], mesh.colors[i][2], mesh.colors[i][3]});
  return key;
}

template <class T>
Buffer<T> gathered(const Buffer<T>& values, const std::vector<std::uint32_t>& chosen) {
  std::vector<T> result;
  if (values.empty()) return result;
  result.reserve(chosen.size());
  for (const std::uint32_t i : chosen) result.push_back(values[i]);
  return result;
}

}  // namespace

Mesh weld(const Mesh& mesh) {
  std::unordered_map<Key, std::uint32_t, KeyHash> seen;
  seen.reserve(mesh.positions.size());
  std::vector<std::uint32_t> chosen;
  std::vector<Eigen::Matrix<std::uint32_t, 3, 1>> triangles;
  triangles.reserve(mesh.triangles.size());
  for (const auto& triangle : mesh.triangles) {
    auto& welded = triangles.emplace_back();
    for (int corner = 0; corner < 3; ++corner) {
      const auto next = static_cast<std::uint32_t>(chosen.size());
      const auto [found, added] = seen.try_emplace(key_of(mesh, triangle[corner]), next);
      if (added) chosen.push_back(triangle[corner]);
      welded[corner] = found->second;
    }
  }
  Mesh result = mesh;
  result.positions = gathered(mesh.positions, chosen);
  result.normals = gathered(mesh.normals, chosen);
  result.uv = gathered(mesh.uv, chosen);
  result.colors = gathered(mesh.colors, chosen);
  result.triangles = std::move(triangles);
  return result;
}

}  // namespace wiw::scene
