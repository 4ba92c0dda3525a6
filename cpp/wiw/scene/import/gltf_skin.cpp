// SPDX-License-Identifier: Apache-2.0
#include "wiw/scene/import/gltf_skin.hpp"

#include <Eigen/LU>
#include <algorithm>

#include "wiw/core/error.hpp"
#include "wiw/scene/import/gltf_nodes.hpp"

namespace wiw::scene {
namespace {

[[noreturn]] void fail(const std::filesystem::path& path, const std::string& cause) {
  throw FileError(path.string(), cause + " (damaged file)");
}

std::vector<std::size_t> parents_of(const Json::Array& nodes) {
  std::vector<std::size_t> parents(nodes.size(), SIZE_MAX);
  for (std::size_t i = 0; i < nodes.size(); ++i) {
    for (const Json& child : nodes[i]["children"].items()) {
      const std::size_t index = child.whole().value_or(SIZE_MAX);
      if (index < nodes.size()) parents[index] = i;
    }
  }
  return parents;
}

}  // namespace

std::vector<Eigen::Matrix4f> joint_matrices(const Json& document, std::size_t skin,
                                            const std::function<GltfValues(std::size_t)>& read,
                                            const std::filesystem::path& path) {
  const Json& entry = document["skins"].items().at(skin);
  const Json::Array& nodes = document["nodes"].items();
  const std::vector<std::size_t> parents = parents_of(nodes);
  GltfValues binds;
  if (const auto accessor = entry["inverseBindMatrices"].whole()) binds = read(*accessor);
  std::vector<Eigen::Matrix4f> matrices;
  for (const Json& joint : entry["joints"].items()) {
    std::size_t node = joint.whole().value_or(SIZE_MAX);
    if (node >= nodes.size()) fail(path, "skin " + std::to_string(skin) + " names a joint that is not there");
    Eigen::Matrix4f transform = Eigen::Matrix4f::Identity();
    for (std::size_t steps = 0; node != SIZE_MAX; node = parents[node]) {
      if (++steps > nodes.size()) fail(path, "a joint of skin " + std::to_string(skin) + " is above itself");
      transform = local_transform(nodes[node]) * transform;
    }
    const bool has_bind = binds.components == 16 && matrices.size() < binds.count;
    if (has_bind) transform = transform * Eigen::Map<const Eigen::Matrix4f>(binds.row(matrices.size()));
    matrices.push_back(transform);
  }
  return matrices;
}

std::vector<Eigen::Matrix4f> vertex_maps(const SkinWeights& skin, const std::vector<Eigen::Matrix4f>& joints,
                                         const std::filesystem::path& path) {
  const std::size_t count = skin.joints[0].count;
  std::vector<Eigen::Matrix4f> maps(count, Eigen::Matrix4f::Zero());
  std::vector<float> sums(count, 0);
  for (std::size_t set = 0; set < skin.joints.size(); ++set) {
    const GltfValues& which = skin.joints[set];
    const GltfValues& weights = skin.weights[set];
    if (which.components != 4 || weights.components != 4 || which.count != count || weights.count != count) {
      fail(path, "a skinned mesh has joints and weights that do not fit each other");
    }
    for (std::size_t i = 0; i < count; ++i) {
      for (std::size_t k = 0; k < 4; ++k) {
        const float weight = weights.row(i)[k];
        const float joint = which.row(i)[k];
        if (weight == 0) continue;
        if (!(joint >= 0) || joint >= static_cast<float>(joints.size()))
          fail(path, "a vertex names a joint that is not there");
        maps[i] += weight * joints[static_cast<std::size_t>(joint)];
        sums[i] += weight;
      }
    }
  }
  for (std::size_t i = 0; i < count; ++i) {
    if (sums[i] > 0) {
      maps[i] /= sums[i];
    } else {
      maps[i].setIdentity();
    }
  }
  return maps;
}

void move_vertices(const std::vector<Eigen::Matrix4f>& maps, bool are_normals, GltfValues& values) {
  if (values.components != 3) return;
  for (std::size_t i = 0; i < std::min(maps.size(), values.count); ++i) {
    Eigen::Map<Eigen::Vector3f> row(values.row(i));
    if (are_normals) {
      row = (maps[i].topLeftCorner<3, 3>().inverse().transpose() * row).eval().normalized();
    } else {
      row = (maps[i].topLeftCorner<3, 3>() * row + maps[i].topRightCorner<3, 1>()).eval();
    }
  }
}

}  // namespace wiw::scene
