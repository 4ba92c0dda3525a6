// SPDX-License-Identifier: Apache-2.0
#include "wiw/scene/import/mesh_baker.hpp"

#include <Eigen/SVD>
#include <algorithm>
#include <utility>

namespace wiw::scene {
namespace {

/// Normals are covectors: n' ~ A^-T n, whose sign keeps them on their side under a mirroring map. A map that flattens
/// has no inverse; there the triangles' own normals, which the renderer takes if there are none, are the right ones.
std::vector<Eigen::Vector3f> mapped_normals(const Mesh& source, const Eigen::Matrix3f& linear) {
  Eigen::Matrix3f normal_map = linear.inverse().transpose();
  std::vector<Eigen::Vector3f> normals;
  if (!normal_map.allFinite()) return normals;
  normal_map /= normal_map.cwiseAbs().maxCoeff();
  normals.reserve(source.normals.size());
  for (const Eigen::Vector3f& normal : source.normals) normals.push_back((normal_map * normal).normalized());
  return normals;
}

Mesh transformed(const Mesh& source, const Eigen::Affine3f& map) {
  Mesh mesh = source;
  std::vector<Eigen::Vector3f> positions;
  positions.reserve(source.positions.size());
  for (const Eigen::Vector3f& position : source.positions) positions.push_back(map * position);
  mesh.positions = std::move(positions);

  mesh.normals = mapped_normals(source, map.linear());

  if (map.linear().determinant() < 0.f) {
    std::vector<Eigen::Matrix<std::uint32_t, 3, 1>> triangles(source.triangles.begin(), source.triangles.end());
    for (auto& triangle : triangles) std::swap(triangle[1], triangle[2]);
    mesh.triangles = std::move(triangles);
  }
  return mesh;
}

}  // namespace

RotationStretch split_rotation(const Eigen::Matrix3f& linear) {
  // An exact rotation is kept bit by bit, and so is its identity stretch: meshes are then shared, not copied.
  if ((linear * linear.transpose()).isIdentity(1e-6f) && linear.determinant() > 0.f) {
    return {linear, Eigen::Matrix3f::Identity()};
  }
  const Eigen::JacobiSVD<Eigen::Matrix3d> svd(linear.cast<double>(), Eigen::ComputeFullU | Eigen::ComputeFullV);
  Eigen::Matrix3d u = svd.matrixU();
  const Eigen::Matrix3d& v = svd.matrixV();
  if ((u * v.transpose()).determinant() < 0.) u.col(2) *= -1.;
  const Eigen::Matrix3d rotation = u * v.transpose();
  const Eigen::Matrix3d stretch = rotation.transpose() * linear.cast<double>();
  return {rotation.cast<float>(), stretch.cast<float>()};
}

std::uint32_t MeshBaker::bake(const Mesh& source, const Eigen::Affine3f& map, std::int32_t material) {
  std::array<float, 12> entries{};
  std::copy_n(map.affine().eval().data(), entries.size(), entries.begin());
  const auto index = static_cast<std::uint32_t>(scene_.meshes.size());
  const auto [found, added] = baked_.try_emplace(Key{&source, entries, material}, index);
  if (!added) return found->second;
  const bool unchanged = map.matrix() == Eigen::Matrix4f::Identity();
  scene_.meshes.push_back(unchanged ? source : transformed(source, map));
  scene_.meshes.back().material = material;
  return index;
}

}  // namespace wiw::scene
