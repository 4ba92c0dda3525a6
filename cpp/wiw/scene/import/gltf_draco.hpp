// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstdint>
#include <filesystem>
#include <memory>
#include <span>
#include <vector>

#include "wiw/scene/import/gltf_data.hpp"

namespace draco {
class Mesh;
}

namespace wiw::scene {

/// A primitive that KHR_draco_mesh_compression holds.
class DracoMesh {
 public:
  /// Throws FileError for damaged data.
  DracoMesh(std::span<const std::uint8_t> encoded, std::filesystem::path path);
  ~DracoMesh();
  DracoMesh(const DracoMesh&) = delete;
  DracoMesh& operator=(const DracoMesh&) = delete;

  [[nodiscard]] std::size_t vertex_count() const;
  /// Corners of triangles, three by three.
  [[nodiscard]] std::vector<std::uint32_t> indices() const;
  /// The attribute of that number; normalised integers are fractions where `normalized` says so. Throws FileError if
  /// there is none of `components` components.
  [[nodiscard]] GltfValues values(std::uint32_t id, std::size_t components, bool normalized) const;

 private:
  std::filesystem::path path_;
  std::unique_ptr<draco::Mesh> mesh_;
};

}  // namespace wiw::scene
