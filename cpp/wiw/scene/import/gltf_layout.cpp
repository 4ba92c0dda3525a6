// SPDX-License-Identifier: Apache-2.0
#include "wiw/scene/import/gltf_layout.hpp"

#include <algorithm>
#include <array>
#include <string_view>
#include <vector>

#include "wiw/core/error.hpp"

namespace wiw::scene {
namespace {

struct BufferView {
  std::uint64_t bytes = 0;
  std::uint64_t stride = 0;  // 0: elements lie densely
};

struct ElementType {
  std::string_view name;
  std::uint64_t components;
};
constexpr std::array<ElementType, 7> kTypes{
    {{"SCALAR", 1}, {"VEC2", 2}, {"VEC3", 3}, {"VEC4", 4}, {"MAT2", 4}, {"MAT3", 9}, {"MAT4", 16}}};

/// Bytes of a component: (U)BYTE, (U)SHORT, UINT, FLOAT; 0 for any other code.
std::uint64_t component_bytes(std::uint64_t code) {
  if (code == 5120 || code == 5121) return 1;
  if (code == 5122 || code == 5123) return 2;
  return code == 5125 || code == 5126 ? 4 : 0;
}

class GltfLayoutChecker {
 public:
  GltfLayoutChecker(const Json& document, std::optional<std::size_t> body, const std::string& path)
      : document_(document), body_(body), path_(path) {}

  void check() {
    for (const Json& view : document_["bufferViews"].items()) add_view(view);
    for (const Json& accessor : document_["accessors"].items()) add_accessor(accessor);
    for (const Json& mesh : document_["meshes"].items()) {
      for (const Json& primitive : mesh["primitives"].items()) check_primitive(primitive);
    }
    for (const Json& skin : document_["skins"].items()) check_skin(skin);
  }

 private:
  [[noreturn]] void fail(const std::string& cause) const { throw FileError(path_, cause + " (damaged file)"); }

  std::uint64_t number(const Json& object, std::string_view name, std::uint64_t otherwise) const {
    const Json& value = object[name];
    if (value.is_null()) return otherwise;
    if (!value.whole()) fail("has a '" + std::string(name) + "' that is no whole number");
    return *value.whole();
  }

  /// The entry of `table` that `object[name]` names by its index.
  template <class T>
  const T& entry(const std::vector<T>& table, const Json& object, std::string_view name) const {
    const std::uint64_t index = number(object, name, UINT64_MAX);
    if (index >= table.size()) {
      fail("names " + std::string(name) + " " + std::to_string(index) + " of " + std::to_string(table.size()));
    }
    return table[index];
  }

  std::uint64_t buffer_bytes(const Json& part) const {
    const Json& buffer = entry(document_["buffers"].items(), part, "buffer");
    const bool is_body = body_ && &buffer == document_["buffers"].items().data() && buffer["uri"].is_null();
    return is_body ? *body_ : number(buffer, "byteLength", 0);
  }

  /// The bytes of a part of a buffer, which must have them.
  std::uint64_t checked_bytes(const Json& part) const {
    const std::uint64_t available = buffer_bytes(part);
    const std::uint64_t offset = number(part, "byteOffset", 0);
    const std::uint64_t bytes = number(part, "byteLength", 0);
    if (offset > available || bytes > available - offset) {
      fail("bufferView " + std::to_string(views_.size()) + " has " + std::to_string(bytes) + " bytes from " +
           std::to_string(offset) + ", but its buffer " + std::to_string(available));
    }
    return bytes;
  }

  /// Of a compressed view, the extension says where the bytes are; its own buffer need not exist.
  void add_view(const Json& view) {
    const Json& compression = view["extensions"]["EXT_meshopt_compression"];
    const std::uint64_t stride = number(view, "byteStride", 0);
    if (compression.is_null()) {
      views_.push_back({checked_bytes(view), stride});
      return;
    }
    checked_bytes(compression);
    const std::uint64_t bytes = number(view, "byteLength", 0);
    const std::uint64_t count = number(compression, "count", 0);
    const std::uint64_t element = number(compression, "byteStride", 0);
    if (count != 0 && (bytes % count != 0 || bytes / count != element)) {
      fail("bufferView " + std::to_string(views_.size()) + " has " + std::to_string(bytes) + " bytes, but " +
           std::to_string(count) + " compressed elements of " + std::to_string(element));
    }
    views_.push_back({count == 0 ? 0 : bytes, stride});
  }

  std::uint64_t type_bytes(const Json& object, std::string_view type) const {
    const auto* row = std::ranges::find(kTypes, type, &ElementType::name);
    const std::uint64_t component = component_bytes(number(object, "componentType", 0));
    if (row == kTypes.end() || component == 0) {
      fail("accessor " + std::to_string(counts_.size()) + " has elements of an unknown type");
    }
    return row->components * component;
  }

  /// `count` elements from the object's byteOffset must lie inside its buffer view.
  void check_fit(const Json& object, std::uint64_t count, std::uint64_t element) const {
    const BufferView& view = entry(views_, object, "bufferView");
    const std::uint64_t offset = number(object, "byteOffset", 0);
    const std::uint64_t step = std::max(view.stride, element);
    if (count == 0) return;
    if (offset <= view.bytes && element <= view.bytes - offset && count - 1 <= (view.bytes - offset - element) / step) {
      return;
    }
    fail("accessor " + std::to_string(counts_.size()) + " reads " + std::to_string(count) + " elements, " +
         std::to_string(step) + " bytes apart, from byte " + std::to_string(offset) + " of a bufferView of " +
         std::to_string(view.bytes));
  }

  void add_accessor(const Json& accessor) {
    const std::uint64_t count = number(accessor, "count", 0);
    const std::uint64_t element = type_bytes(accessor, accessor["type"].text());
    const Json& sparse = accessor["sparse"];
    if (!accessor["bufferView"].is_null()) check_fit(accessor, count, element);
    if (!sparse.is_null()) {
      const std::uint64_t changed = number(sparse, "count", 0);
      check_fit(sparse["indices"], changed, type_bytes(sparse["indices"], "SCALAR"));
      check_fit(sparse["values"], changed, element);
    }
    counts_.push_back(count);
  }

  void check_same_count(const Json& attributes, std::optional<std::uint64_t>& count) const {
    for (const auto& [name, index] : attributes.members()) {
      const std::uint64_t found = entry(counts_, attributes, name);
      if (count && found != *count) {
        fail("a mesh has " + std::to_string(found) + " values of " + name + " for " + std::to_string(*count) +
             " vertices");
      }
      count = found;
    }
  }

  void check_primitive(const Json& primitive) const {
    std::optional<std::uint64_t> vertices;
    check_same_count(primitive["attributes"], vertices);
    for (const Json& target : primitive["targets"].items()) check_same_count(target, vertices);
    if (!primitive["indices"].is_null()) entry(counts_, primitive, "indices");
    const Json& compression = primitive["extensions"]["KHR_draco_mesh_compression"];
    if (!compression.is_null()) entry(views_, compression, "bufferView");
  }

  void check_skin(const Json& skin) const {
    if (skin["inverseBindMatrices"].is_null()) return;
    const std::uint64_t matrices = entry(counts_, skin, "inverseBindMatrices");
    const std::size_t joints = skin["joints"].items().size();
    if (matrices < joints) {
      fail("a skin has " + std::to_string(matrices) + " matrices for " + std::to_string(joints) + " joints");
    }
  }

  const Json& document_;
  std::optional<std::size_t> body_;
  const std::string& path_;
  std::vector<BufferView> views_;
  std::vector<std::uint64_t> counts_;  // of each accessor's elements
};

}  // namespace

void check_gltf_layout(const Json& document, std::optional<std::size_t> body, const std::string& path) {
  GltfLayoutChecker(document, body, path).check();
}

}  // namespace wiw::scene
