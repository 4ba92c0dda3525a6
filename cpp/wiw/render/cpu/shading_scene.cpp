// SPDX-License-Identifier: Apache-2.0
#include "wiw/render/cpu/shading_scene.hpp"

#include <array>
#include <cmath>
#include <cstring>
#include <limits>

#include "wiw/core/error.hpp"
#include "wiw/core/thread_pool.hpp"
#include "wiw/render/bulge.hpp"
#include "wiw/render/cpu/record_order.hpp"
#include "wiw/render/texel_density.hpp"

namespace wiw::render::cpu {

namespace {

const scene::Material& material_of(const scene::Scene& scene, const scene::Mesh& mesh) {
  static const scene::Material plain;
  return mesh.material == scene::kNone ? plain : scene.materials[static_cast<std::size_t>(mesh.material)];
}

bool is_textured(const scene::Scene& scene, const scene::Mesh& mesh) {
  return material_of(scene, mesh).texture != scene::kNone && !mesh.uv.empty();
}

bool is_lightmapped(const scene::Mesh& mesh) { return mesh.lightmap != scene::kNone && !mesh.lightmap_uv.empty(); }

bool needs_detail(const scene::Scene& scene, const scene::Mesh& mesh) {
  const bool ambient = !is_lightmapped(mesh) && !material_of(scene, mesh).emissive;
  return !mesh.colors.empty() || (ambient && !mesh.normals.empty());
}

/// Value at vertex 0, then the differences that barycentric interpolation needs.
void write_differences(const Buffer<Eigen::Vector2f>& values, const scene::Triangle& triangle, float* out) {
  if (values.empty()) return;
  const Eigen::Vector2f& first = values[triangle[0]];
  const Eigen::Vector2f to_1 = values[triangle[1]] - first;
  const Eigen::Vector2f to_2 = values[triangle[2]] - first;
  for (int c = 0; c < 2; ++c) {
    out[c] = first[c];
    out[2 + c] = to_1[c];
    out[4 + c] = to_2[c];
  }
}

using Normals = std::vector<Eigen::Vector3f>;

Normals normals_of(const scene::Mesh& mesh, const Eigen::Matrix3f& linear) {
  const Eigen::Matrix3f to_world = linear.inverse().transpose();
  Normals normals;
  normals.reserve(mesh.normals.size());
  for (const Eigen::Vector3f& normal : mesh.normals) normals.push_back((to_world * normal).normalized());
  return normals;
}

float bulge_of(const scene::Mesh& mesh, const scene::Triangle& triangle, const Eigen::Matrix3f& linear,
               const Normals& normals) {
  std::array<Eigen::Vector3f, 3> corners;
  std::array<Eigen::Vector3f, 3> at_corners;
  for (std::size_t i = 0; i < 3; ++i) {
    const std::uint32_t vertex = triangle[static_cast<Eigen::Index>(i)];
    corners[i] = linear * mesh.positions[vertex];
    at_corners[i] = normals[vertex];
  }
  return triangle_bulge(corners, at_corners);
}

void write_normals(const scene::Triangle& triangle, const Normals& normals, float* out) {
  const Eigen::Vector3f& first = normals[triangle[0]];
  const Eigen::Vector3f to_1 = normals[triangle[1]] - first;
  const Eigen::Vector3f to_2 = normals[triangle[2]] - first;
  for (int c = 0; c < 3; ++c) {
    out[c] = first[c];
    out[3 + c] = to_1[c];
    out[6 + c] = to_2[c];
  }
}

}  // namespace

ShadingScene::ShadingScene(const scene::Scene& scene) : scene_(scene) {
  if (scene_.sun) {
    // Without components that are dust beside the others, which Embree's reciprocals overflow on.
    for (int c = 0; c < 3; ++c) {
      sun_.direction[c] = std::abs(scene_.sun->direction[c]) < 1e-15f ? 0.f : scene_.sun->direction[c];
    }
    sun_.strength = scene_.sun->strength;
    sun_.ambient = scene_.sun->ambient;
  }
  add_parts();
  orders_.resize(scene_.meshes.size());
  parallel_for(orders_.size(), [this](std::size_t i) { orders_[i] = spatial_order(scene_.meshes[i]); });
  stretches_.resize(parts_.size());
  parallel_for(parts_.size(), [this](std::size_t i) {
    const InstanceMesh& part = parts_[i];
    const scene::Instance& instance = scene_.instances[part.instance];
    const scene::Mesh& mesh = scene_.meshes[part.mesh];
    for (std::size_t t = 0; t < mesh.triangles.size(); ++t) {
      const std::size_t number = place_of(part, t);
      TriangleRecord& record = records_[part.first_record + number];
      write_differences(mesh.uv, mesh.triangles[t], record.uv);
      write_differences(mesh.lightmap_uv, mesh.triangles[t], record.light_uv);
      record.surface = part.surface;
      record.instance = instance.id;
      record.detail =
          part.first_detail == kNoDetail ? kNoDetail : part.first_detail + static_cast<std::uint32_t>(number);
      if (mesh.colors.empty() || part.first_detail == kNoDetail) continue;
      for (int k = 0; k < 3; ++k) {
        std::memcpy(&details_[record.detail].color[k], mesh.colors[mesh.triangles[t][k]].data(), 4);
      }
    }
    place(i, instance.T_world_instance);
  });
}

void ShadingScene::add_parts() {
  std::size_t records = 0;
  std::size_t details = 0;
  for (std::uint32_t i = 0; i < scene_.instances.size(); ++i) {
    for (const std::uint32_t index : scene_.instances[i].meshes) {
      const scene::Mesh& mesh = scene_.meshes[index];
      InstanceMesh part{i, index, add_surface(mesh), static_cast<std::uint32_t>(records), kNoDetail};
      records += mesh.triangles.size();
      if (needs_detail(scene_, mesh)) {
        part.first_detail = static_cast<std::uint32_t>(details);
        details += mesh.triangles.size();
      }
      parts_.push_back(part);
      first_record_.push_back(part.first_record);
    }
  }
  if (records > std::numeric_limits<std::int32_t>::max() / kRecordWords) {
    throw ArgumentError("render: the scene places " + std::to_string(records) +
                        " triangles; expected at most 134 million");
  }
  TriangleDetail plain{};
  for (auto& color : plain.color) color = 0xFFFFFFFFu;
  records_.resize(std::max<std::size_t>(1, records));  // kernels read record 0 for rays that hit nothing
  details_.resize(std::max<std::size_t>(1, details), plain);
}

std::uint32_t ShadingScene::add_surface(const scene::Mesh& mesh) {
  const bool textured = is_textured(scene_, mesh);
  const std::int32_t lightmap = is_lightmapped(mesh) ? mesh.lightmap : scene::kNone;
  const SurfaceKey key{mesh.material, lightmap, textured, !mesh.colors.empty()};
  const auto [entry, is_new] = surface_numbers_.try_emplace(key, static_cast<std::uint32_t>(surfaces_.size()));
  if (!is_new) return entry->second;
  const scene::Material& material = material_of(scene_, mesh);
  ShadingSurface surface{};
  for (int c = 0; c < 3; ++c) surface.base_color[c] = material.base_color[c];
  surface.base_alpha = material.base_color[3];
  surface.alpha_cutoff = material.alpha_cutoff;
  surface.emissive = material.emissive;
  surface.vertex_colors = !mesh.colors.empty();
  if (textured) surface.texture = add_texture(material.texture, TextureStore::Use::kSurface);
  if (lightmap != scene::kNone) surface.lightmap = add_texture(lightmap, TextureStore::Use::kLightmap);
  surfaces_.push_back(surface);
  return entry->second;
}

const SampledTexture* ShadingScene::add_texture(std::int32_t index, TextureStore::Use use) {
  auto& store = textures_[{index, use}];
  if (!store) store = std::make_unique<TextureStore>(scene_.textures[static_cast<std::size_t>(index)], use);
  return &store->sampled();
}

void ShadingScene::place(std::size_t number, const Eigen::Affine3f& T_world_instance) {
  place_texels(number, T_world_instance.linear());
  const InstanceMesh& part = parts_[number];
  const scene::Mesh& mesh = scene_.meshes[part.mesh];
  if (part.first_detail == kNoDetail || mesh.normals.empty()) return;
  const Normals normals = normals_of(mesh, T_world_instance.linear());
  for (std::size_t t = 0; t < mesh.triangles.size(); ++t) {
    write_normals(mesh.triangles[t], normals, details_[part.first_detail + place_of(part, t)].normal);
  }
  if (scene_.sun) place_bulges(number, T_world_instance.linear());
}

void ShadingScene::place_texels(std::size_t number, const Eigen::Matrix3f& linear) {
  const InstanceMesh& part = parts_[number];
  const SampledTexture* texture = surfaces_[part.surface].texture;
  if (texture == nullptr) return;
  const scene::Mesh& mesh = scene_.meshes[part.mesh];
  const Eigen::Vector2f size(texture->width[0], texture->height[0]);
  for (std::size_t t = 0; t < mesh.triangles.size(); ++t) {
    const scene::Triangle& triangle = mesh.triangles[t];
    TriangleRecord& record = records_[part.first_record + place_of(part, t)];
    const Eigen::Vector3f first = mesh.positions[triangle[0]];
    const Eigen::Vector3f to_1 = linear * (mesh.positions[triangle[1]] - first);
    const Eigen::Vector3f to_2 = linear * (mesh.positions[triangle[2]] - first);
    const Eigen::Vector2f uv_1 = size.cwiseProduct(Eigen::Vector2f(record.uv[2], record.uv[3]));
    const Eigen::Vector2f uv_2 = size.cwiseProduct(Eigen::Vector2f(record.uv[4], record.uv[5]));
    record.log2_density = std::log2(texel_density(to_1, to_2, uv_1, uv_2));
  }
}

void ShadingScene::place_bulges(std::size_t number, const Eigen::Matrix3f& linear) {
  // A turn changes no bulge: all turned poses share the one of the mesh as it is, to the last bit.
  const Eigen::Matrix3f stretch = linear.isUnitary(1e-4f) ? Eigen::Matrix3f::Identity() : linear;
  std::optional<Eigen::Matrix3f>& last = stretches_[number];
  if (last == stretch) return;
  last = stretch;
  const InstanceMesh& part = parts_[number];
  const scene::Mesh& mesh = scene_.meshes[part.mesh];
  const Normals normals = normals_of(mesh, stretch);
  for (std::size_t t = 0; t < mesh.triangles.size(); ++t) {
    details_[part.first_detail + place_of(part, t)].bulge = bulge_of(mesh, mesh.triangles[t], stretch, normals);
  }
}

void ShadingScene::describe(KernelScene& kernel) const {
  kernel.sun = scene_.sun ? &sun_ : nullptr;
  kernel.first_record = first_record_.data();
  kernel.records = records_.data();
  kernel.details = details_.data();
  kernel.surfaces = surfaces_.data();
  for (int c = 0; c < 3; ++c) {
    kernel.zenith[c] = scene_.sky.zenith[c];
    kernel.horizon[c] = scene_.sky.horizon[c];
  }
}

}  // namespace wiw::render::cpu
