// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <Eigen/Geometry>
#include <filesystem>
#include <optional>
#include <string>
#include <vector>

namespace wiw::scene::sdf {

enum class ShapeKind { kMesh, kBox, kSphere, kCylinder, kPlane };

struct Geometry {
  ShapeKind shape = ShapeKind::kMesh;
  std::filesystem::path mesh;
  std::string submesh;  // only this part of the mesh, if named
  /// Mesh: scale. Box: lengths. Sphere: radius. Cylinder: radius, length. Plane: lengths along x and y.
  Eigen::Vector3d size = Eigen::Vector3d::Ones();
  Eigen::Vector3d normal = Eigen::Vector3d::UnitZ();  // of a plane
};

struct ModelVisual {
  Eigen::Isometry3d T_model_visual = Eigen::Isometry3d::Identity();
  Geometry geometry;
  std::optional<Eigen::Vector4f> color;  // replaces a mesh's own materials
};

/// A model that owns links, placed in the world.
struct Model {
  std::string name;  // of the placement: "ChairA_01_001"
  std::string kind;  // of the model that was placed: "aws_robomaker_residential_ChairA_01"
  Eigen::Isometry3d T_world_model = Eigen::Isometry3d::Identity();
  std::vector<ModelVisual> visuals;
};

/// A world file and all the models it includes, before any mesh is opened. Axes as in the file: Z up.
struct SdfWorld {
  std::string name;
  std::vector<Model> models;
  std::vector<std::string> warnings;
};

}  // namespace wiw::scene::sdf
