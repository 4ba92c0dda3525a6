// SPDX-License-Identifier: Apache-2.0
#include "wiw/scene/sdf/assembler.hpp"

#include <algorithm>
#include <set>

#include "wiw/core/error.hpp"
#include "wiw/core/thread_pool.hpp"
#include "wiw/scene/assemble.hpp"
#include "wiw/scene/import/category.hpp"
#include "wiw/scene/import/ceiling.hpp"
#include "wiw/scene/import/extent.hpp"
#include "wiw/scene/import/up_axis.hpp"
#include "wiw/scene/sdf/primitives.hpp"
#include "wiw/scene/text.hpp"

namespace wiw::scene::sdf {
namespace {

const Eigen::Vector4f kNeutral(0.7f, 0.7f, 0.7f, 1.f);

Eigen::Affine3f z_to_y_up() { return Eigen::Affine3f(UpAxis{'Z', ""}.to_y_up()); }

std::vector<double> key_of(const Geometry& g) {
  return {static_cast<double>(g.shape), g.size.x(), g.size.y(), g.size.z(), g.normal.x(), g.normal.y(), g.normal.z()};
}

}  // namespace

Assembler::Assembler(const SdfWorld& world, const ImportOptions& options)
    : world_(world), options_(options), scene_(std::make_shared<Scene>()), baker_(*scene_) {}

ScenePtr Assembler::assemble(const std::filesystem::path& path) {
  scene_->name = world_.name;
  scene_->attributes["up"] = UpAxis{'Z', "Gazebo SDF"}.text();
  scene_->warnings = world_.warnings;
  load_parts();
  for (const Model& model : world_.models) add_model(model);
  if (scene_->instances.empty()) throw FileError(path.string(), "holds no triangles");
  check_imported(*scene_, path);
  if (options_.ceiling_height) add_ceiling(*scene_, *options_.ceiling_height);
  make_text_utf8(*scene_);
  return scene_;
}

void Assembler::load_parts() {
  std::set<std::filesystem::path> unique;
  for (const Model& model : world_.models) {
    for (const ModelVisual& visual : model.visuals) {
      if (visual.geometry.shape == ShapeKind::kMesh) unique.insert(visual.geometry.mesh);
    }
  }
  const std::vector<std::filesystem::path> files(unique.begin(), unique.end());
  std::vector<ScenePtr> parts(files.size());
  std::vector<ImportTrace> traces(files.size());
  SharedCount texture_bytes;
  parallel_for(files.size(), [&](std::size_t i) {
    ImportOptions options = options_;
    options.up = Up::kY;  // as the file has it: SDF poses ignore a mesh file's own up axis
    options.ceiling_height.reset();
    options.trace = &traces[i];
    options.texture_bytes = &texture_bytes;
    parts[i] = load_mesh(files[i], options);
  });
  for (std::size_t i = 0; i < files.size(); ++i) {
    add_part(files[i], std::move(parts[i]));
    if (!options_.trace) continue;
    auto& trace = *options_.trace;
    trace.read.insert(trace.read.end(), traces[i].read.begin(), traces[i].read.end());
    trace.absent.insert(trace.absent.end(), traces[i].absent.begin(), traces[i].absent.end());
  }
}

void Assembler::add_part(const std::filesystem::path& file, ScenePtr part) {
  const std::int32_t first_material = add_appearance(*part, *scene_);
  parts_[file] = {std::move(part), first_material};
}

void Assembler::add_model(const Model& model) {
  const Eigen::Affine3f turn = z_to_y_up();
  Instance instance;
  instance.id = static_cast<std::uint32_t>(scene_->instances.size() + 1);
  instance.name = model.name;
  instance.T_world_instance = turn * Eigen::Affine3f(model.T_world_model.matrix().cast<float>()) * turn.inverse();
  for (const ModelVisual& visual : model.visuals) add_visual(visual, instance);
  if (instance.meshes.empty()) return;
  instance.category = category_index(*scene_, category_from_name(model.kind));
  instance.attributes["model"] = model.kind;
  count(instance);
  scene_->instances.push_back(std::move(instance));
}

void Assembler::add_visual(const ModelVisual& visual, Instance& instance) {
  const Eigen::Affine3f T_instance_visual = z_to_y_up() * Eigen::Affine3f(visual.T_model_visual.matrix().cast<float>());
  if (visual.geometry.shape == ShapeKind::kMesh) {
    add_mesh(visual, T_instance_visual, instance);
    return;
  }
  const Mesh*& primitive = primitive_of_[key_of(visual.geometry)];
  if (!primitive) primitive = &primitives_.emplace_back(primitive_mesh(visual.geometry));
  instance.meshes.push_back(
      baker_.bake(*primitive, T_instance_visual, plain_material(visual.color.value_or(kNeutral))));
}

void Assembler::add_mesh(const ModelVisual& visual, const Eigen::Affine3f& T_instance_visual, Instance& instance) {
  const ImportedMesh& part = parts_.at(visual.geometry.mesh);
  const Eigen::Affine3f scale(Eigen::Scaling(visual.geometry.size.cast<float>().eval()));
  bool drawn = false;
  for (const Instance& node : part.scene->instances) {
    if (!visual.geometry.submesh.empty() && node.name != visual.geometry.submesh) continue;
    drawn = true;
    for (const std::uint32_t index : node.meshes) {
      const Mesh& mesh = part.scene->meshes[index];
      const std::int32_t own = mesh.material == kNone ? kNone : part.first_material + mesh.material;
      const std::int32_t material = visual.color ? plain_material(*visual.color) : own;
      instance.meshes.push_back(baker_.bake(mesh, T_instance_visual * scale * node.T_world_instance, material));
    }
  }
  if (!drawn) {
    scene_->warnings.push_back("mesh '" + visual.geometry.mesh.filename().string() + "' has no part '" +
                               visual.geometry.submesh + "'; left out");
  }
}

std::int32_t Assembler::plain_material(const Eigen::Vector4f& color) {
  const auto next = static_cast<std::int32_t>(scene_->materials.size());
  const auto [found, added] = plain_materials_.try_emplace({color[0], color[1], color[2], color[3]}, next);
  if (added) scene_->materials.push_back({.name = "plain", .base_color = color});
  return found->second;
}

void Assembler::count(const Instance& instance) {
  for (const std::uint32_t mesh : instance.meshes) triangles_ += scene_->meshes[mesh].triangles.size();
  check_limit(world_.name, "triangles", triangles_, options_.limits.triangles, "triangles");
}

}  // namespace wiw::scene::sdf
