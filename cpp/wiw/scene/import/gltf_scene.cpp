// SPDX-License-Identifier: Apache-2.0
#include "wiw/scene/import/gltf_scene.hpp"

#include <algorithm>
#include <deque>
#include <map>
#include <tuple>

#include "wiw/core/error.hpp"
#include "wiw/scene/import/category.hpp"
#include "wiw/scene/import/gltf_check.hpp"
#include "wiw/scene/import/gltf_data.hpp"
#include "wiw/scene/import/gltf_geometry.hpp"
#include "wiw/scene/import/gltf_materials.hpp"
#include "wiw/scene/import/gltf_nodes.hpp"
#include "wiw/scene/import/gltf_skin.hpp"
#include "wiw/scene/import/place_meshes.hpp"

namespace wiw::scene {
namespace {

std::string name_or(const Json& entry, const char* kind, std::size_t index) {
  const std::string_view name = entry["name"].text();
  return name.empty() ? std::string(kind) + " " + std::to_string(index) : std::string(name);
}

std::vector<float> numbers_of(const Json& list) {
  std::vector<float> numbers;
  for (const Json& item : list.items()) numbers.push_back(static_cast<float>(item.number().value_or(0)));
  return numbers;
}

class SceneReader {
 public:
  SceneReader(const GltfDocument& document, const std::filesystem::path& path, const ImportOptions& options,
              Scene& scene)
      : root_(document.root), path_(path), options_(options), scene_(scene), data_(document, path, options) {}

  void read(const UpAxis& up) {
    convert_gltf_materials(root_, data_, path_, options_, scene_);
    place_nodes();
    place_meshes(placed_, path_, options_.limits, up, scene_);
  }

 private:
  struct OpenNode {
    std::size_t index;
    Eigen::Matrix4f T_file_parent;
  };

  /// Depth first in file order, without recursion: the depth of the graph is the file's choice.
  void place_nodes() {
    std::vector<OpenNode> open;
    const auto push = [&](const Json& indices, const Eigen::Matrix4f& T_file_parent) {
      const Json::Array& items = indices.items();
      for (std::size_t i = items.size(); i-- > 0;) open.push_back({*items[i].whole(), T_file_parent});
    };
    push(scene_roots(root_), Eigen::Matrix4f::Identity());
    while (!open.empty()) {
      const OpenNode current = open.back();
      open.pop_back();
      const Json& node = root_["nodes"].items()[current.index];
      const Eigen::Matrix4f T_file_node = current.T_file_parent * local_transform(node);
      push(node["children"], T_file_node);
      if (const auto mesh = index_of(node, "mesh", root_["meshes"].items().size())) {
        place_node(node, current.index, *mesh, T_file_node);
      }
    }
  }

  void place_node(const Json& node, std::size_t index, std::size_t mesh, const Eigen::Matrix4f& T_file_node) {
    const auto skin = index_of(node, "skin", root_["skins"].items().size());
    PlacedMeshes placed{name_or(node, "node", index), category_of(node, mesh), Eigen::Affine3f::Identity(),
                        meshes_of(node, mesh, skin)};
    for (const Eigen::Matrix4f& T_node_instance : instances(node, index)) {
      // Where a skinned mesh lies is the joints' matter alone: the node that shows it has no say.
      if (!skin) placed.T_file_node.matrix() = T_file_node * T_node_instance;
      if (!placed.T_file_node.matrix().allFinite()) {
        throw FileError(path_.string(), "the transform of node '" + placed.name + "' is not finite (damaged file)");
      }
      placed_.push_back(placed);
      check_limit(path_.string(), "nodes", placed_.size(), options_.limits.nodes, "nodes");
    }
  }

  /// The node's name says best what a thing is, then its mesh's, then its material's.
  [[nodiscard]] std::string category_of(const Json& node, std::size_t mesh) const {
    const Json& entry = root_["meshes"].items()[mesh];
    std::string category = category_from_name(node["name"].text());
    if (category.empty()) category = category_from_name(entry["name"].text());
    for (const Json& primitive : entry["primitives"].items()) {
      const auto material = index_of(primitive, "material", root_["materials"].items().size());
      if (!category.empty() || !material) continue;
      category = category_from_name(root_["materials"].items()[*material]["name"].text());
    }
    return category;
  }

  // ---- instances

  /// Transforms of EXT_mesh_gpu_instancing; one identity where a node has none.
  std::vector<Eigen::Matrix4f> instances(const Json& node, std::size_t index) {
    const Json& extension = node["extensions"]["EXT_mesh_gpu_instancing"];
    if (extension.is_null()) return {Eigen::Matrix4f::Identity()};
    const auto translations = instance_values(extension, "TRANSLATION", 3, index);
    const auto rotations = instance_values(extension, "ROTATION", 4, index);
    const auto scales = instance_values(extension, "SCALE", 3, index);
    const std::size_t count = std::max({translations.count, rotations.count, scales.count});
    for (const GltfValues* values : {&translations, &rotations, &scales}) {
      if (values->count == 0 || values->count == count) continue;
      throw FileError(path_.string(), "node " + std::to_string(index) + " has " + std::to_string(count) +
                                          " instances, but " + std::to_string(values->count) +
                                          " of some of their values (damaged file)");
    }
    check_limit(path_.string(), "nodes", count, options_.limits.nodes, "nodes");
    std::vector<Eigen::Matrix4f> transforms;
    transforms.reserve(count);
    for (std::size_t i = 0; i < count; ++i) {
      transforms.push_back(compose_transform(translations.count > 0 ? translations.row(i) : nullptr,
                                             rotations.count > 0 ? rotations.row(i) : nullptr,
                                             scales.count > 0 ? scales.row(i) : nullptr));
    }
    return transforms;
  }

  GltfValues instance_values(const Json& extension, const char* attribute, std::size_t components, std::size_t node) {
    const auto accessor = index_of(extension["attributes"], attribute, root_["accessors"].items().size());
    if (!accessor) return {};
    GltfValues values = data_.read(*accessor);
    if (values.components == components) return values;
    throw FileError(path_.string(), "node " + std::to_string(node) + " has instances whose " + attribute + " has " +
                                        std::to_string(values.components) + " components (damaged file)");
  }

  // ---- meshes

  /// A mesh is converted once for each way in which its vertices are moved.
  std::vector<const Mesh*> meshes_of(const Json& node, std::size_t mesh, std::optional<std::size_t> skin) {
    const Json& entry = root_["meshes"].items()[mesh];
    GltfPose pose{numbers_of(node["weights"].is_null() ? entry["weights"] : node["weights"])};
    const auto [known, is_new] = converted_.try_emplace({mesh, skin.value_or(SIZE_MAX), pose.weights});
    if (!is_new) return known->second;
    if (skin) pose.joints = &joints_of(*skin);
    const std::string name = entry["name"].text().empty() ? "mesh " + std::to_string(mesh)
                                                          : "mesh '" + std::string(entry["name"].text()) + "'";
    for (const Json& primitive : entry["primitives"].items()) {
      meshes_.push_back(convert_gltf_primitive(root_, primitive, pose, data_, path_, name, scene_.warnings));
      vertices_ += meshes_.back().positions.size();
      check_limit(path_.string(), "vertices of all poses of its meshes", vertices_, vertex_limit(options_.limits),
                  "triangles");
      known->second.push_back(&meshes_.back());
    }
    return known->second;
  }

  const std::vector<Eigen::Matrix4f>& joints_of(std::size_t skin) {
    const auto [known, is_new] = joints_.try_emplace(skin);
    const auto read = [&](std::size_t accessor) { return data_.read(accessor); };
    if (is_new) known->second = joint_matrices(root_, skin, read, path_);
    return known->second;
  }

  const Json& root_;
  const std::filesystem::path& path_;
  const ImportOptions& options_;
  Scene& scene_;
  GltfData data_;
  std::vector<PlacedMeshes> placed_;
  std::deque<Mesh> meshes_;  // the addresses of its elements last
  std::map<std::tuple<std::size_t, std::size_t, std::vector<float>>, std::vector<const Mesh*>> converted_;
  std::map<std::size_t, std::vector<Eigen::Matrix4f>> joints_;  // by skin
  std::size_t vertices_ = 0;                                    // of `meshes_`
};

}  // namespace

void convert_gltf(const std::filesystem::path& path, MeshFormat format, const ImportOptions& options, const UpAxis& up,
                  Scene& scene) {
  if (options.trace) options.trace->read.push_back(path);
  const GltfDocument document = read_gltf_document(path, format);
  scene.warnings = check_gltf(document, path, options.limits);
  SceneReader(document, path, options, scene).read(up);
}

}  // namespace wiw::scene
