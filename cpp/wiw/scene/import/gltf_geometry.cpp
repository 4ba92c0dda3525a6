// SPDX-License-Identifier: Apache-2.0
#include "wiw/scene/import/gltf_geometry.hpp"

#include <algorithm>
#include <numeric>
#include <optional>

#include "wiw/core/error.hpp"
#include "wiw/scene/import/gltf_draco.hpp"
#include "wiw/scene/import/gltf_materials.hpp"
#include "wiw/scene/import/gltf_skin.hpp"
#include "wiw/scene/import/mesh_arrays.hpp"
#include "wiw/scene/import/polygon.hpp"
#include "wiw/scene/import/weld.hpp"

namespace wiw::scene {
namespace {

constexpr std::uint64_t kTriangles = 4, kStrip = 5, kFan = 6;  // modes of a primitive

/// Corners of the triangles that a strip or a fan stands for.
std::vector<std::uint32_t> unrolled(const std::vector<std::uint32_t>& corners, std::uint64_t mode) {
  std::vector<std::uint32_t> triangles;
  for (std::size_t i = 0; i + 2 < corners.size(); ++i) {
    const bool is_turned = mode == kStrip && i % 2 == 1;
    const std::uint32_t first = mode == kFan ? corners[0] : corners[i];
    const std::uint32_t second = corners[i + 1];
    const std::uint32_t third = corners[i + 2];
    triangles.insert(triangles.end(), {first, is_turned ? third : second, is_turned ? second : third});
  }
  return triangles;
}

/// Whether an accessor has no data, which stands for zeros. Some exporters write such targets of morphs.
bool is_zero(const Json& accessor) { return accessor["bufferView"].is_null() && accessor["sparse"].is_null(); }

template <int size>
std::vector<Eigen::Matrix<float, size, 1>> rows_of(const GltfValues& values) {
  std::vector<Eigen::Matrix<float, size, 1>> rows;
  rows.reserve(values.count);
  for (std::size_t i = 0; i < values.count; ++i) {
    rows.push_back(Eigen::Map<const Eigen::Matrix<float, size, 1>>(values.row(i)));
  }
  return rows;
}

class PrimitiveReader {
 public:
  PrimitiveReader(const Json& document, const Json& primitive, GltfData& data, const std::filesystem::path& path,
                  const std::string& mesh, std::vector<std::string>& warnings)
      : document_(document), primitive_(primitive), data_(data), path_(path), mesh_(mesh), warnings_(warnings) {
    const Json& compression = primitive["extensions"]["KHR_draco_mesh_compression"];
    const auto view = index_of(compression, "bufferView", document["bufferViews"].items().size());
    if (view) draco_.emplace(data_.view(*view), path);
  }

  Mesh read(const GltfPose& pose) {
    Mesh mesh;
    if (!has("POSITION")) return mesh;
    GltfValues positions = morphed("POSITION", pose.weights);
    std::optional<GltfValues> normals;
    if (has("NORMAL")) normals = morphed("NORMAL", pose.weights);
    if (pose.joints != nullptr) apply_skin(*pose.joints, positions, normals);
    auto points = rows_of<3>(positions);
    check_positions(points, path_, mesh_);
    mesh.triangles = triangles(points);
    mesh.positions = std::move(points);
    if (normals) mesh.normals = usable_normals(*normals);
    mesh.uv = texture_coordinates();
    mesh.colors = colors();
    const auto material = index_of(primitive_, "material", document_["materials"].items().size());
    mesh.material = material ? static_cast<std::int32_t>(*material) : kNone;
    return weld(mesh);
  }

 private:
  [[noreturn]] void fail(const std::string& cause) const {
    throw FileError(path_.string(), mesh_ + " " + cause + " (damaged file)");
  }
  void warn(const std::string& cause) {
    const std::string warning = mesh_ + " of " + path_.filename().string() + " " + cause;
    if (std::ranges::find(warnings_, warning) == warnings_.end()) warnings_.push_back(warning);
  }

  [[nodiscard]] bool has(const std::string& attribute) const { return !primitive_["attributes"][attribute].is_null(); }

  /// Values of an attribute, which has one of these numbers of components.
  GltfValues values(const std::string& attribute, std::size_t components, std::size_t or_components = 0) {
    const std::size_t index = primitive_["attributes"][attribute].whole().value_or(SIZE_MAX);
    const Json& accessor = document_["accessors"].items().at(index);
    const std::size_t found = components_of(accessor["type"].text());
    if (found != components && found != or_components) {
      fail("has " + attribute + " of " + std::to_string(found) + " components");
    }
    const Json& compression = primitive_["extensions"]["KHR_draco_mesh_compression"];
    const auto id = compression["attributes"][attribute].whole();
    if (!draco_ || !id) return data_.read(index);
    if (draco_->vertex_count() != accessor["count"].whole()) {
      fail("has " + std::to_string(draco_->vertex_count()) + " vertices, but should have " +
           std::to_string(accessor["count"].whole().value_or(0)));
    }
    return draco_->values(static_cast<std::uint32_t>(std::min<std::uint64_t>(*id, UINT32_MAX)), found,
                          accessor["normalized"].is_true());
  }

  GltfValues morphed(const char* attribute, const std::vector<float>& weights) {
    GltfValues sum = values(attribute, 3);
    const Json::Array& targets = primitive_["targets"].items();
    for (std::size_t t = 0; t < std::min(targets.size(), weights.size()); ++t) {
      const auto target = index_of(targets[t], attribute, document_["accessors"].items().size());
      if (!target || weights[t] == 0 || is_zero(document_["accessors"].items()[*target])) continue;
      const GltfValues change = data_.read(*target);
      if (change.numbers.size() != sum.numbers.size()) fail("has a morph target that does not fit its vertices");
      for (std::size_t i = 0; i < sum.numbers.size(); ++i) sum.numbers[i] += weights[t] * change.numbers[i];
    }
    return sum;
  }

  void apply_skin(const std::vector<Eigen::Matrix4f>& joints, GltfValues& positions,
                  std::optional<GltfValues>& normals) {
    SkinWeights skin;
    for (std::size_t set = 0;; ++set) {
      const std::string number = std::to_string(set);
      if (!has("JOINTS_" + number) || !has("WEIGHTS_" + number)) break;
      skin.joints.push_back(values("JOINTS_" + number, 4));
      skin.weights.push_back(values("WEIGHTS_" + number, 4));
    }
    if (skin.joints.empty()) return;
    const std::vector<Eigen::Matrix4f> maps = vertex_maps(skin, joints, path_);
    move_vertices(maps, false, positions);
    if (normals) move_vertices(maps, true, *normals);
  }

  std::vector<std::uint32_t> corners(std::size_t vertices) {
    if (draco_) return draco_->indices();
    if (const auto indices = primitive_["indices"].whole()) return data_.read_indices(*indices);
    std::vector<std::uint32_t> all(vertices);
    std::iota(all.begin(), all.end(), 0U);
    return all;
  }

  std::vector<Triangle> triangles(const std::vector<Eigen::Vector3f>& positions) {
    std::vector<Triangle> triangles;
    const std::uint64_t mode = primitive_["mode"].is_null() ? kTriangles : primitive_["mode"].whole().value_or(0);
    if (mode < kTriangles || mode > kFan) {
      warn("has points or lines, which are not drawn");
      return triangles;
    }
    std::vector<std::uint32_t> corners = this->corners(positions.size());
    if (mode != kTriangles && !draco_) corners = unrolled(corners, mode);
    triangles.reserve(corners.size() / 3);
    for (std::size_t i = 0; i + 2 < corners.size(); i += 3) {
      const std::span<const std::uint32_t> triangle = std::span(corners).subspan(i, 3);
      const std::uint32_t last = *std::ranges::max_element(triangle);
      if (last >= positions.size()) {
        fail("has a triangle " + std::to_string(i / 3) + " that names vertex " + std::to_string(last) + " of " +
             std::to_string(positions.size()));
      }
      triangulate(triangle, positions, triangles);
    }
    return triangles;
  }

  std::vector<Eigen::Vector3f> usable_normals(const GltfValues& values) {
    auto normals = rows_of<3>(values);
    if (!normalize_normals(normals)) warn("has normals of no length; its geometric normals are used");
    return normals;
  }

  std::vector<Eigen::Vector2f> texture_coordinates() {
    const Json::Array& materials = document_["materials"].items();
    const auto material = index_of(primitive_, "material", materials.size());
    const auto placement = material ? texture_placement(materials[*material]) : std::nullopt;
    if (!placement) return {};
    const std::string attribute = "TEXCOORD_" + std::to_string(placement->set);
    if (!has(attribute)) {
      warn("has no " + attribute + ", which its texture takes; drawn without texture");
      return {};
    }
    GltfValues uv = values(attribute, 2);
    for (std::size_t i = 0; i < uv.count; ++i) placement->apply(uv.row(i));
    auto rows = rows_of<2>(uv);
    check_texture_coordinates(rows, path_, mesh_);
    return rows;
  }

  std::vector<Eigen::Matrix<std::uint8_t, 4, 1>> colors() {
    std::vector<Eigen::Matrix<std::uint8_t, 4, 1>> colors;
    if (!has("COLOR_0")) return colors;
    const GltfValues linear = values("COLOR_0", 3, 4);
    colors.reserve(linear.count);
    for (std::size_t i = 0; i < linear.count; ++i) {
      const float* row = linear.row(i);
      const std::uint8_t alpha = linear.components == 4 ? display_byte(row[3], false) : std::uint8_t{255};
      colors.emplace_back(display_byte(row[0], true), display_byte(row[1], true), display_byte(row[2], true), alpha);
    }
    return colors;
  }

  const Json& document_;
  const Json& primitive_;
  GltfData& data_;
  const std::filesystem::path& path_;
  const std::string& mesh_;
  std::vector<std::string>& warnings_;
  std::optional<DracoMesh> draco_;
};

}  // namespace

Mesh convert_gltf_primitive(const Json& document, const Json& primitive, const GltfPose& pose, GltfData& data,
                            const std::filesystem::path& path, const std::string& mesh,
                            std::vector<std::string>& warnings) {
  return PrimitiveReader(document, primitive, data, path, mesh, warnings).read(pose);
}

}  // namespace wiw::scene
