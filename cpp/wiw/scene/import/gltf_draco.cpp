// SPDX-License-Identifier: Apache-2.0
#include "wiw/scene/import/gltf_draco.hpp"

#include <draco/compression/decode.h>
#include <draco/mesh/mesh.h>

#include <array>
#include <utility>

#include "wiw/core/error.hpp"

namespace wiw::scene {
namespace {

/// glTF's code of a component; 0 for types that glTF does not have.
std::uint64_t component_code(draco::DataType type) {
  switch (type) {
    case draco::DT_INT8: return 5120;
    case draco::DT_UINT8: return 5121;
    case draco::DT_INT16: return 5122;
    case draco::DT_UINT16: return 5123;
    case draco::DT_UINT32: return 5125;
    case draco::DT_FLOAT32: return 5126;
    default: return 0;
  }
}

}  // namespace

DracoMesh::DracoMesh(std::span<const std::uint8_t> encoded, std::filesystem::path path) : path_(std::move(path)) {
  draco::DecoderBuffer buffer;
  buffer.Init(reinterpret_cast<const char*>(encoded.data()), encoded.size());
  draco::Decoder decoder;
  auto decoded = decoder.DecodeMeshFromBuffer(&buffer);
  if (!decoded.ok()) {
    throw FileError(path_.string(), "has a primitive that KHR_draco_mesh_compression cannot decode: " +
                                        decoded.status().error_msg_string() + " (damaged file)");
  }
  mesh_ = std::move(decoded).value();
}

DracoMesh::~DracoMesh() = default;

std::size_t DracoMesh::vertex_count() const { return mesh_->num_points(); }

std::vector<std::uint32_t> DracoMesh::indices() const {
  std::vector<std::uint32_t> indices;
  indices.reserve(3 * std::size_t{mesh_->num_faces()});
  for (draco::FaceIndex i(0); i < mesh_->num_faces(); ++i) {
    for (const draco::PointIndex& point : mesh_->face(i)) indices.push_back(point.value());
  }
  return indices;
}

GltfValues DracoMesh::values(std::uint32_t id, std::size_t components, bool normalized) const {
  const draco::PointAttribute* attribute = mesh_->GetAttributeByUniqueId(id);
  const std::uint64_t code = attribute == nullptr ? 0 : component_code(attribute->data_type());
  if (code == 0 || static_cast<std::size_t>(attribute->num_components()) != components) {
    throw FileError(path_.string(), "has no attribute " + std::to_string(id) + " of " + std::to_string(components) +
                                        " components in its compressed primitive (damaged file)");
  }
  const std::size_t bytes = static_cast<std::size_t>(draco::DataTypeLength(attribute->data_type()));
  std::array<std::uint8_t, 4 * kMostComponents> row{};
  GltfValues values{vertex_count(), components, {}};
  values.numbers.reserve(values.count * components);
  for (draco::PointIndex point(0); point < mesh_->num_points(); ++point) {
    const draco::AttributeValueIndex index = attribute->mapped_index(point);
    if (index >= static_cast<std::uint32_t>(attribute->size())) {
      throw FileError(path_.string(), "has a vertex without values in its compressed primitive (damaged file)");
    }
    attribute->GetValue(index, row.data());
    for (std::size_t c = 0; c < components; ++c) {
      values.numbers.push_back(component_value(row.data() + c * bytes, code, normalized));
    }
  }
  return values;
}

}  // namespace wiw::scene
