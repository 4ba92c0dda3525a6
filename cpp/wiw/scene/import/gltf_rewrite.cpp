// SPDX-License-Identifier: Apache-2.0
#include "wiw/scene/import/gltf_rewrite.hpp"

#include <algorithm>
#include <array>
#include <cmath>
#include <cstring>
#include <optional>
#include <set>
#include <string_view>

#include "wiw/core/error.hpp"
#include "wiw/scene/import/gltf_data.hpp"
#include "wiw/scene/import/gltf_nodes.hpp"
#include "wiw/scene/import/gltf_skin.hpp"

namespace wiw::scene {
namespace {

constexpr std::uint64_t kFloat = 5126;
constexpr const char* kBufferName = "wiw-values-as-floats.bin";
constexpr float kEdge = 1e-3f;  // texture coordinates so far outside are rounding
constexpr std::string_view kInstancing = "EXT_mesh_gpu_instancing";
constexpr std::string_view kTransform = "KHR_texture_transform";

std::optional<std::size_t> index_of(const Json& object, std::string_view name, std::size_t size) {
  const auto index = object[name].whole();
  return index && *index < size ? index : std::nullopt;
}

/// The name of texture coordinates, normals, ... that the scene has use for.
bool is_drawn(std::string_view attribute) {
  return attribute == "POSITION" || attribute == "NORMAL" || attribute.starts_with("TEXCOORD_") ||
         attribute.starts_with("COLOR_");
}

/// u, v -> offset + R(rotation) S(scale) (u, v), counter-clockwise where v points down.
struct TextureTransform {
  explicit TextureTransform(const Json& extension)
      : offset(pair(extension["offset"], 0)),
        scale(pair(extension["scale"], 1)),
        rotation(static_cast<float>(extension["rotation"].number().value_or(0))) {}

  void apply(float* uv) const {
    const float u = scale[0] * uv[0];
    const float v = scale[1] * uv[1];
    uv[0] = offset[0] + std::cos(rotation) * u + std::sin(rotation) * v;
    uv[1] = offset[1] - std::sin(rotation) * u + std::cos(rotation) * v;
  }

  static std::array<float, 2> pair(const Json& numbers, double otherwise) {
    const Json::Array& items = numbers.items();
    const auto number = [&](std::size_t i) { return i < items.size() ? items[i].number() : std::nullopt; };
    return {static_cast<float>(number(0).value_or(otherwise)), static_cast<float>(number(1).value_or(otherwise))};
  }

  std::array<float, 2> offset, scale;
  float rotation;
};

class Rewriter {
 public:
  Rewriter(const GltfDocument& document, const std::filesystem::path& path, const ImportOptions& options)
      : path_(path), options_(options), root_(document.root), data_(document, path, options) {
    for (const Json& accessor : root_["accessors"].items()) accessors_.push_back(accessor);
  }

  GltfRewrite run(MeshFormat format) {
    decode_buffer_names();
    place_instances();
    pose_nodes();
    for (Json& mesh : items("meshes")) {
      for (Json& primitive : mesh.member("primitives").list()) {
        choose_texture_coordinates(primitive);
        unpack_attributes(primitive);
      }
    }
    for (Json& material : items("materials")) simplify_material(material);
    if (changed_) finish(format);
    return std::move(result_);
  }

 private:
  /// The elements of a list of the document; none where there is no such list.
  Json::Array& items(std::string_view name) {
    static thread_local Json::Array none;
    none.clear();
    return root_[name].is_null() ? none : root_.member(name).list();
  }

  GltfValues values(std::size_t accessor) {
    const std::size_t original = accessors_.size() - added_.size();
    return accessor < original ? data_.read(accessor) : added_.at(accessor - original);
  }

  std::size_t add(GltfValues values) {
    constexpr std::array<const char*, 4> kTypes{"SCALAR", "VEC2", "VEC3", "VEC4"};
    Json accessor;
    accessor.member("componentType") = Json::from(std::size_t{kFloat});
    accessor.member("count") = Json::from(values.count);
    accessor.member("type") = Json::from(std::string_view(kTypes.at(values.components - 1)));
    rows_ += values.count;
    check_limit(path_.string(), "vertices to be rewritten", rows_, vertex_limit(options_.limits), "triangles");
    accessors_.push_back(std::move(accessor));
    added_.push_back(std::move(values));
    changed_ = true;
    return accessors_.size() - 1;
  }

  void decode_buffer_names() {
    for (Json& buffer : items("buffers")) {
      const std::string uri(buffer["uri"].text());
      if (uri.starts_with("data:") || decode_percent_escapes(uri) == uri) continue;
      buffer.member("uri") = Json::from(std::string_view(decode_percent_escapes(uri)));
      changed_ = true;
    }
  }

  // ---- instances

  void place_instances() {
    const std::size_t count = items("nodes").size();
    std::size_t placed = count;
    for (std::size_t i = 0; i < count; ++i) {
      const Json extension = root_["nodes"].items()[i]["extensions"][kInstancing];
      if (extension.is_null() || root_["nodes"].items()[i]["mesh"].is_null()) continue;
      placed += add_instances(i, extension["attributes"]);
      check_limit(path_.string(), "nodes", placed, options_.limits.nodes, "nodes");
    }
  }

  std::size_t add_instances(std::size_t node, const Json& attributes) {
    struct TransformProperty {
      const char* attribute;
      const char* member;
      std::size_t components;
    };
    constexpr std::array<TransformProperty, 3> kParts{
        {{"TRANSLATION", "translation", 3}, {"ROTATION", "rotation", 4}, {"SCALE", "scale", 3}}};
    std::vector<Json> copies;
    for (const TransformProperty& part : kParts) {
      const auto accessor = index_of(attributes, part.attribute, accessors_.size());
      if (!accessor) continue;
      const GltfValues rows = values(*accessor);
      if (rows.components != part.components || (!copies.empty() && copies.size() != rows.count)) {
        throw FileError(path_.string(), "node " + std::to_string(node) + " has instances whose " + part.attribute +
                                            " does not fit the others (damaged file)");
      }
      check_limit(path_.string(), "nodes", rows.count, options_.limits.nodes, "nodes");
      copies.resize(rows.count);
      for (std::size_t i = 0; i < rows.count; ++i) {
        for (std::size_t c = 0; c < rows.components; ++c) {
          copies[i].member(part.member).list().push_back(Json::from(double{rows.row(i)[c]}));
        }
      }
    }
    add_children(node, copies);
    return copies.size();
  }

  /// Makes the instances children of their node, each with its name and mesh.
  void add_children(std::size_t node, std::vector<Json>& copies) {
    Json::Array& nodes = items("nodes");
    for (Json& copy : copies) {
      for (const char* member : {"name", "mesh", "skin", "weights"}) {
        if (!nodes[node][member].is_null()) copy.member(member) = nodes[node][member];
      }
      nodes[node].member("children").list().push_back(Json::from(nodes.size()));
      nodes.push_back(std::move(copy));
    }
    for (const char* member : {"mesh", "skin", "weights", "extensions"}) nodes[node].erase(member);
    changed_ = true;
  }

  // ---- morph weights and skins

  /// Meshes whose vertices lie elsewhere at rest than their attributes say.
  void pose_nodes() {
    const std::size_t count = items("nodes").size();
    const std::vector<bool> reachable = reachable_nodes();
    for (std::size_t i = 0; i < count; ++i) {
      const Json node = root_["nodes"].items()[i];
      const auto mesh = index_of(node, "mesh", items("meshes").size());
      if (!mesh || !reachable[i]) continue;
      const Json& own = node["weights"];
      const std::vector<float> weights = numbers_of(own.is_null() ? items("meshes")[*mesh]["weights"] : own);
      const auto skin = index_of(node, "skin", items("skins").size());
      const bool is_morphed = std::ranges::any_of(weights, [](float weight) { return weight != 0; });
      if (skin || is_morphed) pose_node(i, *mesh, skin, weights);
    }
    for (Json& mesh : items("meshes")) {
      mesh.erase("weights");
      for (Json& primitive : mesh.member("primitives").list()) primitive.erase("targets");
    }
    for (Json& node : items("nodes")) {
      node.erase("skin");
      node.erase("weights");
    }
    root_.erase("skins");
    root_.erase("animations");
  }

  void pose_node(std::size_t index, std::size_t mesh, std::optional<std::size_t> skin,
                 const std::vector<float>& weights) {
    Json posed = items("meshes")[mesh];
    for (Json& primitive : posed.member("primitives").list()) {
      morph(primitive, "POSITION", weights);
      morph(primitive, "NORMAL", weights);
      if (skin) apply_skin(primitive, joints_of(*skin));
    }
    items("meshes").push_back(std::move(posed));
    const std::size_t added = items("meshes").size() - 1;
    Json::Array& nodes = items("nodes");
    if (!skin) {
      nodes[index].member("mesh") = Json::from(added);
      return;
    }
    // Where a skinned mesh lies is the joints' matter alone: the node that shows it has no say.
    Json shown;
    if (!nodes[index]["name"].is_null()) shown.member("name") = nodes[index]["name"];
    shown.member("mesh") = Json::from(added);
    nodes[index].erase("mesh");
    nodes.push_back(std::move(shown));
    const std::size_t scene = root_["scene"].whole().value_or(0);
    items("scenes").at(scene).member("nodes").list().push_back(Json::from(nodes.size() - 1));
  }

  const std::vector<Eigen::Matrix4f>& joints_of(std::size_t skin) {
    const auto [known, is_new] = joints_.try_emplace(skin);
    const auto read = [&](std::size_t accessor) { return values(accessor); };
    if (is_new) known->second = joint_matrices(root_, skin, read, path_);
    return known->second;
  }

  std::vector<bool> reachable_nodes() {
    std::vector<bool> reachable(items("nodes").size(), false);
    std::vector<std::size_t> open;
    const auto visit = [&](const Json& indices) {
      for (const Json& each : indices.items()) {
        const std::size_t node = each.whole().value_or(SIZE_MAX);
        if (node >= reachable.size() || reachable[node]) continue;
        reachable[node] = true;
        open.push_back(node);
      }
    };
    visit(scene_roots(root_));
    while (!open.empty()) {
      const std::size_t node = open.back();
      open.pop_back();
      visit(root_["nodes"].items()[node]["children"]);
    }
    return reachable;
  }

  static std::vector<float> numbers_of(const Json& list) {
    std::vector<float> numbers;
    for (const Json& item : list.items()) numbers.push_back(static_cast<float>(item.number().value_or(0)));
    return numbers;
  }

  void morph(Json& primitive, const char* attribute, const std::vector<float>& weights) {
    const auto base = index_of(primitive["attributes"], attribute, accessors_.size());
    if (!base) return;
    GltfValues sum = values(*base);
    const Json::Array& targets = primitive["targets"].items();
    for (std::size_t t = 0; t < std::min(targets.size(), weights.size()); ++t) {
      const auto target = index_of(targets[t], attribute, accessors_.size());
      if (!target || weights[t] == 0) continue;
      const GltfValues change = values(*target);
      if (change.numbers.size() != sum.numbers.size()) continue;
      for (std::size_t i = 0; i < sum.numbers.size(); ++i) sum.numbers[i] += weights[t] * change.numbers[i];
    }
    primitive.member("attributes").member(attribute) = Json::from(add(std::move(sum)));
  }

  void apply_skin(Json& primitive, const std::vector<Eigen::Matrix4f>& joints) {
    Json& attributes = primitive.member("attributes");
    SkinWeights skin;
    for (std::size_t set = 0;; ++set) {
      const auto which = index_of(attributes, "JOINTS_" + std::to_string(set), accessors_.size());
      const auto weights = index_of(attributes, "WEIGHTS_" + std::to_string(set), accessors_.size());
      if (!which || !weights) break;
      skin.joints.push_back(values(*which));
      skin.weights.push_back(values(*weights));
    }
    if (skin.joints.empty()) return;
    const std::vector<Eigen::Matrix4f> maps = vertex_maps(skin, joints, path_);
    for (const char* attribute : {"POSITION", "NORMAL"}) {
      const auto accessor = index_of(attributes, attribute, accessors_.size());
      if (!accessor) continue;
      GltfValues moved = values(*accessor);
      move_vertices(maps, std::string_view(attribute) == "NORMAL", moved);
      attributes.member(attribute) = Json::from(add(std::move(moved)));
    }
  }

  // ---- texture coordinates

  void choose_texture_coordinates(Json& primitive) {
    const auto index = index_of(primitive, "material", items("materials").size());
    if (!index) return;
    const Json& material = items("materials")[*index];
    const Json& texture = texture_to_draw(material);
    const Json& transform = texture["extensions"][kTransform];
    const Json& override = transform["texCoord"];
    const std::size_t set = (override.is_null() ? texture["texCoord"] : override).whole().value_or(0);
    const auto accessor = index_of(primitive["attributes"], "TEXCOORD_" + std::to_string(set), accessors_.size());
    if (texture.is_null() || !accessor) return;
    const auto [wraps_u, wraps_v] = wrap_modes(texture);
    if (transform.is_null() && set == 0 && wraps_u.empty() && wraps_v.empty()) return;
    GltfValues uv = values(*accessor);
    if (uv.components != 2) return;
    if (!transform.is_null()) {
      const TextureTransform map(transform);
      for (std::size_t i = 0; i < uv.count; ++i) map.apply(uv.row(i));
    }
    warn_of_edges(material, *index, uv, {wraps_u, wraps_v});
    if (transform.is_null() && set == 0) return;
    Json& attributes = primitive.member("attributes");
    const Json::Object names = attributes.members();
    for (const auto& [name, unused] : names) {
      if (name.starts_with("TEXCOORD_")) attributes.erase(name);
    }
    attributes.member("TEXCOORD_0") = Json::from(add(std::move(uv)));
  }

  /// How a texture goes on beyond its edges, by axis: "clamped", "mirrored" or "" for repeated.
  [[nodiscard]] std::array<std::string, 2> wrap_modes(const Json& info) const {
    const auto texture = index_of(info, "index", root_["textures"].items().size());
    if (!texture) return {};
    const auto sampler = index_of(root_["textures"].items()[*texture], "sampler", root_["samplers"].items().size());
    if (!sampler) return {};
    const auto text = [&](const char* name) {
      const std::uint64_t mode = root_["samplers"].items()[*sampler][name].whole().value_or(10497);
      return std::string(mode == 33071 ? "clamped" : (mode == 33648 ? "mirrored" : ""));
    };
    return {text("wrapS"), text("wrapT")};
  }

  void warn_of_edges(const Json& material, std::size_t index, const GltfValues& uv,
                     const std::array<std::string, 2>& wraps) {
    for (std::size_t axis = 0; axis < 2; ++axis) {
      if (wraps[axis].empty()) continue;
      const auto is_outside = [&](std::size_t i) { return uv.row(i)[axis] < -kEdge || uv.row(i)[axis] > 1 + kEdge; };
      bool outside = false;
      for (std::size_t i = 0; i < uv.count && !outside; ++i) outside = is_outside(i);
      if (!outside || !warned_materials_.insert(index).second) continue;
      const std::string name = material["name"].text().empty()
                                   ? "material " + std::to_string(index)
                                   : "material '" + std::string(material["name"].text()) + "'";
      result_.warnings.push_back("the texture of " + name + " of " + path_.filename().string() + " should be " +
                                 wraps[axis] + " beyond its edges, and is drawn repeated");
    }
  }

  /// Leaves of a material what is drawn, as `choose_texture_coordinates` made the coordinates.
  void simplify_material(Json& material) {
    const auto plain = [&](Json& info) {
      if (info["extensions"][kTransform].is_null() && info["texCoord"].whole().value_or(0) == 0) return;
      info.erase("extensions");
      info.erase("texCoord");
      changed_ = true;
    };
    const bool has_base = !material["pbrMetallicRoughness"]["baseColorTexture"].is_null();
    if (has_base) plain(material.member("pbrMetallicRoughness").member("baseColorTexture"));
    if (!material["emissiveTexture"].is_null()) plain(material.member("emissiveTexture"));
    if (!material["pbrMetallicRoughness"].is_null())
      material.member("pbrMetallicRoughness").erase("metallicRoughnessTexture");
    for (const char* unused : {"normalTexture", "occlusionTexture"}) material.erase(unused);
  }

  // ---- values

  /// Attributes as floats that lie densely, where assimp reads others wrongly or not at all.
  void unpack_attributes(Json& primitive) {
    const Json::Object attributes = primitive["attributes"].members();
    for (const auto& [name, unused] : attributes) {
      const auto accessor = index_of(primitive["attributes"], name, accessors_.size());
      if (!accessor || is_plain(*accessor, name.starts_with("COLOR_"))) continue;
      if (!is_drawn(name)) {
        primitive.member("attributes").erase(name);
        changed_ = true;
        continue;
      }
      GltfValues floats = values(*accessor);
      if (floats.components == 0 || floats.components > 4) continue;
      primitive.member("attributes").member(name) = Json::from(add(std::move(floats)));
    }
  }

  /// assimp takes for granted that the last row of a view has as many bytes as the others.
  bool is_plain(std::size_t index, bool is_color) {
    const Json& accessor = accessors_[index];
    const std::uint64_t component = accessor["componentType"].whole().value_or(0);
    const bool is_vec4 = accessor["type"].text() == "VEC4";
    if (component != kFloat && !(is_color && is_vec4 && accessor["normalized"].is_true())) return false;
    const auto view = index_of(accessor, "bufferView", root_["bufferViews"].items().size());
    if (!view) return true;
    const Json& entry = root_["bufferViews"].items()[*view];
    const std::uint64_t stride = entry["byteStride"].whole().value_or(0);
    return stride * accessor["count"].whole().value_or(0) <= entry["byteLength"].whole().value_or(0);
  }

  // ---- the new file

  void finish(MeshFormat format) {
    std::vector<std::uint8_t> bytes;
    Json::Array& views = root_.member("bufferViews").list();
    Json::Array& buffers = root_.member("buffers").list();
    const std::size_t first = accessors_.size() - added_.size();
    for (std::size_t i = 0; i < added_.size(); ++i) {
      const std::vector<float>& numbers = added_[i].numbers;
      Json view;
      view.member("buffer") = Json::from(buffers.size());
      view.member("byteOffset") = Json::from(bytes.size());
      view.member("byteLength") = Json::from(numbers.size() * sizeof(float));
      accessors_[first + i].member("bufferView") = Json::from(views.size());
      views.push_back(std::move(view));
      const auto* begin = reinterpret_cast<const std::uint8_t*>(numbers.data());
      bytes.insert(bytes.end(), begin, begin + numbers.size() * sizeof(float));
    }
    if (!bytes.empty()) {
      Json buffer;
      buffer.member("byteLength") = Json::from(bytes.size());
      buffer.member("uri") = Json::from(std::string_view(kBufferName));
      buffers.push_back(std::move(buffer));
      result_.files[kBufferName] = std::move(bytes);
    }
    root_.member("accessors").list() = std::move(accessors_);
    root_.erase("extensionsRequired");
    result_.files[path_.filename().string()] = format == MeshFormat::kGlb ? glb_bytes(root_, data_.body()) : text();
  }

  [[nodiscard]] std::vector<std::uint8_t> text() const {
    const std::string written = root_.write();
    return {written.begin(), written.end()};
  }

  const std::filesystem::path& path_;
  const ImportOptions& options_;
  Json root_;
  GltfData data_;
  std::vector<Json> accessors_;    // the document's, and behind them one of each of `added_`
  std::vector<GltfValues> added_;  // values that take the place of others
  std::size_t rows_ = 0;           // of these
  std::map<std::size_t, std::vector<Eigen::Matrix4f>> joints_;  // by skin
  std::set<std::size_t> warned_materials_;                      // materials
  bool changed_ = false;
  GltfRewrite result_;
};

}  // namespace

const Json& texture_to_draw(const Json& material) {
  const Json& base = material["pbrMetallicRoughness"]["baseColorTexture"];
  return base.is_null() || is_emissive_only(material) ? material["emissiveTexture"] : base;
}

bool is_emissive_only(const Json& material) {
  const auto is_black = [](const Json& color, double otherwise) {
    for (std::size_t i = 0; i < 3; ++i) {
      const auto& items = color.items();
      if ((i < items.size() ? items[i].number().value_or(otherwise) : otherwise) > 0) return false;
    }
    return true;
  };
  return is_black(material["pbrMetallicRoughness"]["baseColorFactor"], 1) && !is_black(material["emissiveFactor"], 0);
}

GltfRewrite rewrite_gltf(const GltfDocument& document, const std::filesystem::path& path, MeshFormat format,
                         const ImportOptions& options) {
  return Rewriter(document, path, options).run(format);
}

}  // namespace wiw::scene
