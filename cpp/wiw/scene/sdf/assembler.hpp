// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <deque>
#include <map>

#include "wiw/scene/import.hpp"
#include "wiw/scene/import/mesh_baker.hpp"
#include "wiw/scene/sdf/world.hpp"

namespace wiw::scene::sdf {

/// Turns the placed models of a world into a scene: loads each mesh file once, in parallel, and shares baked meshes
/// between placements.
class Assembler {
 public:
  Assembler(const SdfWorld& world, const ImportOptions& options);
  ScenePtr assemble(const std::filesystem::path& path);

 private:
  struct ImportedMesh {
    ScenePtr scene;
    std::int32_t first_material = 0;
  };
  void load_parts();
  void add_part(const std::filesystem::path& file, ScenePtr part);
  void add_model(const Model& model);
  void add_visual(const ModelVisual& visual, Instance& instance);
  void add_mesh(const ModelVisual& visual, const Eigen::Affine3f& T_instance_visual, Instance& instance);
  std::int32_t plain_material(const Eigen::Vector4f& color);
  void count(const Instance& instance);

  const SdfWorld& world_;
  const ImportOptions& options_;
  std::shared_ptr<Scene> scene_;
  MeshBaker baker_;
  std::map<std::filesystem::path, ImportedMesh> parts_;
  std::deque<Mesh> primitives_;  // a deque, because the baker keeps pointers
  std::map<std::vector<double>, const Mesh*> primitive_of_;
  std::map<std::array<float, 4>, std::int32_t> plain_materials_;
  std::size_t triangles_ = 0;
};

}  // namespace wiw::scene::sdf
