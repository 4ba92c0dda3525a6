// SPDX-License-Identifier: Apache-2.0
#include "wiw/scene/import/gltf_nodes.hpp"

#include <Eigen/Geometry>
#include <algorithm>
#include <cstdint>
#include <vector>

#include "wiw/core/error.hpp"

namespace wiw::scene {
namespace {

constexpr int kDeepest = 1000;  // nodes in nodes

/// The `size` numbers of a node's member; `otherwise` where there are none.
template <int size>
Eigen::Matrix<float, size, 1> numbers(const Json& list, const Eigen::Matrix<float, size, 1>& otherwise) {
  Eigen::Matrix<float, size, 1> values = otherwise;
  const Json::Array& items = list.items();
  if (items.size() != size) return values;
  for (int i = 0; i < size; ++i)
    values[i] = static_cast<float>(items[static_cast<std::size_t>(i)].number().value_or(0));
  return values;
}

class NodeCounter {
 public:
  NodeCounter(const Json& document, const ImportLimits& limits, const std::string& path)
      : nodes_(document["nodes"].items()), limits_(limits), path_(path), sizes_(nodes_.size(), 0) {}

  std::size_t total(const Json& indices, int depth) {
    std::size_t sum = 0;
    for (const Json& index : indices.items()) {
      if (!index.whole() || *index.whole() >= nodes_.size()) {
        throw FileError(path_, "names a node that is not there (damaged file)");
      }
      sum += size(*index.whole(), depth);
      check_limit(path_, "nodes", sum, limits_.nodes, "nodes");
    }
    return sum;
  }

 private:
  static constexpr std::size_t kOpen = SIZE_MAX;  // being counted

  /// How many nodes come of one.
  std::size_t size(std::size_t node, int depth) {
    if (depth > kDeepest)
      throw FileError(path_, "its nodes are nested more than " + std::to_string(kDeepest) + " deep (damaged file)");
    if (sizes_[node] == kOpen) {
      throw FileError(path_, "node " + std::to_string(node) + " is among its own descendants (damaged file)");
    }
    if (sizes_[node] > 0) return sizes_[node];
    sizes_[node] = kOpen;
    return sizes_[node] = 1 + total(nodes_[node]["children"], depth + 1);
  }

  const Json::Array& nodes_;
  const ImportLimits& limits_;
  const std::string& path_;
  std::vector<std::size_t> sizes_;
};

void check_vertices(const Json& document, const ImportLimits& limits, const std::string& path) {
  const std::size_t most = vertex_limit(limits);
  const Json::Array& accessors = document["accessors"].items();
  std::size_t vertices = 0;
  for (const Json& mesh : document["meshes"].items()) {
    for (const Json& primitive : mesh["primitives"].items()) {
      for (const Json* index : {&primitive["attributes"]["POSITION"], &primitive["indices"]}) {
        if (!index->whole() || *index->whole() >= accessors.size()) continue;
        vertices += std::min<std::size_t>(accessors[*index->whole()]["count"].whole().value_or(0), most);
        check_limit(path, "vertices and corners of all meshes", vertices, most, "triangles");
      }
    }
  }
}

}  // namespace

Eigen::Matrix4f compose_transform(const float* translation, const float* rotation, const float* scale) {
  Eigen::Affine3f transform = Eigen::Affine3f::Identity();
  if (translation != nullptr) transform.translate(Eigen::Map<const Eigen::Vector3f>(translation));
  if (rotation != nullptr) transform.rotate(Eigen::Map<const Eigen::Quaternionf>(rotation).normalized());  // xyzw
  if (scale != nullptr) transform.scale(Eigen::Map<const Eigen::Vector3f>(scale));
  return transform.matrix();
}

Eigen::Matrix4f local_transform(const Json& node) {
  if (!node["matrix"].is_null()) {
    const Eigen::Matrix4f identity = Eigen::Matrix4f::Identity();
    const Eigen::Matrix<float, 16, 1> columns =
        numbers<16>(node["matrix"], Eigen::Map<const Eigen::Matrix<float, 16, 1>>(identity.data()));
    return Eigen::Map<const Eigen::Matrix4f>(columns.data());
  }
  const Eigen::Vector3f translation = numbers<3>(node["translation"], Eigen::Vector3f::Zero());
  const Eigen::Vector4f rotation = numbers<4>(node["rotation"], {0, 0, 0, 1});
  const Eigen::Vector3f scale = numbers<3>(node["scale"], Eigen::Vector3f::Ones());
  return compose_transform(translation.data(), rotation.data(), scale.data());
}

std::size_t vertex_limit(const ImportLimits& limits) {
  constexpr std::size_t kAlways = 1'000'000;  // less is no harm
  return std::max(6 * limits.triangles, kAlways);
}

const Json& scene_roots(const Json& document) {
  static const Json none;
  const Json::Array& scenes = document["scenes"].items();
  const std::size_t scene = document["scene"].whole().value_or(0);
  return scene < scenes.size() ? scenes[scene]["nodes"] : none;
}

void check_gltf_size(const Json& document, const ImportLimits& limits, const std::string& path) {
  const std::size_t scenes = document["scenes"].items().size();
  if (scenes == 0 && !document["nodes"].items().empty()) {  // glTF 2.0, 3.5.1: such a file is a library of things
    throw FileError(path,
                    "has nodes but no scene that says which of them to show (a library of things, not a place); "
                    "add a scene with the nodes to show, or export it anew as a scene");
  }
  const auto scene = document["scene"].whole();
  if (scene && *scene >= scenes) throw FileError(path, "names a scene that is not there (damaged file)");
  NodeCounter(document, limits, path).total(scene_roots(document), 0);
  check_vertices(document, limits, path);
}

}  // namespace wiw::scene
