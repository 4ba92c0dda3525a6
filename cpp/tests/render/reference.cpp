// SPDX-License-Identifier: Apache-2.0
#include "render/reference.hpp"

#include <algorithm>
#include <array>
#include <cmath>

#include "wiw/render/bulge.hpp"
#include "wiw/render/shading.hpp"

namespace wiw::testing {

namespace {

using Vector = Eigen::Vector3d;

template <class T, int N>
Eigen::Matrix<double, N, 1> blend(const Buffer<Eigen::Matrix<T, N, 1>>& values, const scene::Mesh& mesh,
                                  std::size_t triangle, double b1, double b2) {
  const auto& corner = mesh.triangles[triangle];
  return (1 - b1 - b2) * values[corner[0]].template cast<double>() + b1 * values[corner[1]].template cast<double>() +
         b2 * values[corner[2]].template cast<double>();
}

bool meets(const Eigen::AlignedBox3d& box, const Vector& origin, const Vector& ray) {
  const Eigen::Array3d to_min = (box.min() - origin).array() / ray.array();
  const Eigen::Array3d to_max = (box.max() - origin).array() / ray.array();
  return to_min.min(to_max).maxCoeff() <= to_min.max(to_max).minCoeff();
}

/// The texel that stands at place `i` of an endless row.
int wrap(int i, int size, scene::Wrap mode) {
  if (mode == scene::Wrap::kClamp) return std::clamp(i, 0, size - 1);
  const int period = mode == scene::Wrap::kMirror ? 2 * size : size;
  const int inside = ((i % period) + period) % period;
  return inside < size ? inside : period - 1 - inside;
}

constexpr scene::Sampling kLightmap{scene::Wrap::kClamp, scene::Wrap::kClamp, false};

}  // namespace

Reference::Reference(const scene::Scene& scene) : scene_(scene) {
  for (const scene::Texture& texture : scene.textures) mips_.push_back(render::build_mips(texture));
  for (const scene::Instance& instance : scene.instances) {
    Eigen::AlignedBox3d box;
    for (const std::uint32_t mesh : instance.meshes) {
      for (const auto& position : scene.meshes[mesh].positions) {
        box.extend((instance.T_world_instance * position).cast<double>());
      }
    }
    box.extend(box.min() - Vector::Constant(0.01));
    box.extend(box.max() + Vector::Constant(0.01));
    bounds_.push_back(box);
  }
}

std::vector<Reference::Hit> Reference::all_hits(const Vector& origin, const Vector& ray, double slack,
                                                double nearest) const {
  std::vector<Hit> hits;
  for (const scene::Instance& instance : scene_.instances) {
    if (!meets(bounds_[instance.id - 1], origin, ray)) continue;
    for (const std::uint32_t index : instance.meshes) {
      const scene::Mesh& mesh = scene_.meshes[index];
      for (std::size_t i = 0; i < mesh.triangles.size(); ++i) {
        const auto corner = [&](int k) -> Vector {
          return (instance.T_world_instance * mesh.positions[mesh.triangles[i][k]]).cast<double>();
        };
        const Vector first = corner(0);
        Eigen::Matrix3d system;  // first + b1 e1 + b2 e2 = origin + t ray
        system << corner(1) - first, corner(2) - first, -ray;
        if (std::abs(system.determinant()) < 1e-12) continue;
        const Vector solution = system.inverse() * (origin - first);
        const double least = std::min({solution[0], solution[1], 1 - solution[0] - solution[1]});
        if (least < -slack || solution[2] < nearest) continue;
        hits.push_back({&mesh, &instance, i, solution[2], solution[0], solution[1], origin + solution[2] * ray,
                        system.col(0), system.col(1)});
      }
    }
  }
  std::ranges::sort(hits, {}, &Hit::t);
  return hits;
}

Eigen::Vector4d Reference::sample(std::int32_t number, int level, const Eigen::Vector2d& uv,
                                  const scene::Sampling& sampling) const {
  const auto index = static_cast<std::size_t>(number);
  const scene::Texture& texture = scene_.textures[index];
  const Size size = level == 0 ? texture.size : mips_[index][static_cast<std::size_t>(level) - 1].size;
  const std::uint8_t* texels =
      level == 0 ? texture.rgba.data() : mips_[index][static_cast<std::size_t>(level) - 1].rgba.data();
  double x = uv.x() * size.width - 0.5;
  double y = uv.y() * size.height - 0.5;
  if (sampling.nearest) {
    x = std::round(x);
    y = std::round(y);
  }
  const double x0 = std::floor(x);
  const double y0 = std::floor(y);
  Eigen::Vector4d sum = Eigen::Vector4d::Zero();
  for (const int dy : {0, 1}) {
    for (const int dx : {0, 1}) {
      const int row = wrap(static_cast<int>(y0) + dy, size.height, sampling.v);
      const int column = wrap(static_cast<int>(x0) + dx, size.width, sampling.u);
      const double weight = (dx ? x - x0 : 1 - x + x0) * (dy ? y - y0 : 1 - y + y0);
      for (int c = 0; c < 4; ++c) sum[c] += weight * texels[4 * (row * size.width + column) + c] / 255.0;
    }
  }
  return sum;
}

bool Reference::is_between_texels(std::int32_t number, const Eigen::Vector2d& uv) const {
  const scene::Texture& texture = scene_.textures[static_cast<std::size_t>(number)];
  const Eigen::Vector2d texels = uv.cwiseProduct(Eigen::Vector2d(texture.size.width, texture.size.height));
  return texture.sampling.nearest && (texels - texels.array().round().matrix()).cwiseAbs().minCoeff() < 1e-3;
}

bool Reference::is_hole(const Hit& hit, bool& doubtful) const {
  if (hit.mesh->material == scene::kNone) return false;
  const scene::Material& material = scene_.materials[static_cast<std::size_t>(hit.mesh->material)];
  if (material.alpha_cutoff < 0) return false;
  double alpha = material.base_color[3];
  if (material.texture != scene::kNone && !hit.mesh->uv.empty()) {
    const Eigen::Vector2d uv = blend(hit.mesh->uv, *hit.mesh, hit.triangle, hit.b1, hit.b2);
    const scene::Sampling sampling = scene_.textures[static_cast<std::size_t>(material.texture)].sampling;
    alpha *= sample(material.texture, 0, uv, sampling)[3];
    doubtful = doubtful || is_between_texels(material.texture, uv);
  }
  doubtful = doubtful || std::abs(alpha - material.alpha_cutoff) < 1e-3;
  return alpha < material.alpha_cutoff;
}

double Reference::level(const Hit& hit, const Vector& ray, double spread) const {
  const scene::Material& material = scene_.materials[static_cast<std::size_t>(hit.mesh->material)];
  const Size size = scene_.textures[static_cast<std::size_t>(material.texture)].size;
  const auto& corner = hit.mesh->triangles[hit.triangle];
  Eigen::Matrix2d texels;
  for (int k = 1; k < 3; ++k) {
    const Eigen::Vector2d uv = (hit.mesh->uv[corner[k]] - hit.mesh->uv[corner[0]]).cast<double>();
    texels.col(k - 1) = uv.cwiseProduct(Eigen::Vector2d(size.width, size.height));
  }
  // Orthonormal frame of the triangle's plane.
  const Vector normal = hit.edge_1.cross(hit.edge_2).normalized();
  const Vector across = hit.edge_1.normalized();
  const Vector along = normal.cross(across);
  Eigen::Matrix2d metres;
  metres << across.dot(hit.edge_1), across.dot(hit.edge_2), along.dot(hit.edge_1), along.dot(hit.edge_2);
  const Eigen::JacobiSVD<Eigen::Matrix2d> svd(texels * metres.inverse());
  const double stretch = std::max(1.0, 1.0 / std::abs(normal.dot(ray)));
  return std::log2(spread * hit.t * stretch * svd.singularValues()[0]);
}

bool Reference::sees_sun(const Vector& point, const Vector& direction, bool& doubtful) const {
  constexpr double kSlack = 1e-4;
  bool blocked = false;
  bool unsure = false;
  for (const Hit& hit : all_hits(point, direction, kSlack, -1e-5)) {
    if (is_hole(hit, unsure)) continue;
    if (std::min({hit.b1, hit.b2, 1 - hit.b1 - hit.b2}) > kSlack && hit.t > 1e-5) return false;
    blocked = blocked || hit.t > 0;
    unsure = true;
  }
  doubtful = doubtful || unsure;
  return !blocked;
}

double Reference::light(const Hit& hit, const Vector& ray, bool& doubtful) const {
  Vector geometric = hit.edge_1.cross(hit.edge_2).normalized();
  if (geometric.dot(ray) > 0) geometric = -geometric;
  Vector normal = geometric;
  double lift = 0;
  if (!hit.mesh->normals.empty()) {
    const Eigen::Matrix3d to_world = hit.instance->T_world_instance.linear().cast<double>().inverse().transpose();
    Buffer<Eigen::Vector3f> turned = [&] {
      std::vector<Eigen::Vector3f> values(hit.mesh->normals.size(), Eigen::Vector3f::Zero());
      for (const std::uint32_t v : hit.mesh->triangles[hit.triangle]) {
        values[v] = (to_world * hit.mesh->normals[v].cast<double>()).normalized().cast<float>();
      }
      return values;
    }();
    normal = blend(turned, *hit.mesh, hit.triangle, hit.b1, hit.b2).normalized();
    if (normal.dot(geometric) < 0) {
      normal = -normal;
    } else {
      std::array<Eigen::Vector3f, 3> corners;
      std::array<Eigen::Vector3f, 3> normals;
      for (std::size_t k = 0; k < 3; ++k) {
        const std::uint32_t vertex = hit.mesh->triangles[hit.triangle][static_cast<Eigen::Index>(k)];
        corners[k] = hit.instance->T_world_instance * hit.mesh->positions[vertex];
        normals[k] = turned[vertex];
      }
      lift =
          render::shading::shadow_lift(static_cast<double>(render::triangle_bulge(corners, normals)), hit.b1, hit.b2);
    }
  }
  const double ambient = render::shading::ambient_light(normal.x(), normal.y(), normal.z());
  if (!scene_.sun) return ambient;
  const scene::Sun& sun = *scene_.sun;
  const Vector direction = sun.direction.cast<double>();
  const double cosine = normal.dot(direction);
  double visibility = 0;
  if (cosine > 0) {
    const Vector sunward = geometric.dot(direction) < 0 ? -geometric : geometric;
    const Vector start = hit.point + lift * normal + render::shading::shadow_offset(hit.t) * sunward;
    visibility = sees_sun(start, direction, doubtful) ? 1 : 0;
  }
  return render::shading::sun_light(ambient, cosine, visibility, sun.ambient, sun.strength);
}

Vector Reference::shade(const Hit& hit, const Vector& ray, double spread, bool& doubtful) const {
  static const scene::Material plain;
  const scene::Mesh& mesh = *hit.mesh;
  const scene::Material& material =
      mesh.material == scene::kNone ? plain : scene_.materials[static_cast<std::size_t>(mesh.material)];
  Vector color = material.base_color.head<3>().cast<double>();
  if (material.texture != scene::kNone && !mesh.uv.empty()) {
    const auto last = static_cast<double>(mips_[static_cast<std::size_t>(material.texture)].size());
    const double lod = std::clamp(level(hit, ray, spread), 0.0, last);
    scene::Sampling sampling = scene_.textures[static_cast<std::size_t>(material.texture)].sampling;
    const bool magnified = lod <= 0;
    sampling.nearest = sampling.nearest && magnified;
    const Eigen::Vector2d uv = blend(mesh.uv, mesh, hit.triangle, hit.b1, hit.b2);
    const int fine = static_cast<int>(lod);
    const int coarse = std::min(fine + 1, static_cast<int>(last));
    const Eigen::Vector4d texel = (1 - lod + fine) * sample(material.texture, fine, uv, sampling) +
                                  (lod - fine) * sample(material.texture, coarse, uv, sampling);
    color = color.cwiseProduct(texel.head<3>());
    doubtful = doubtful || is_between_texels(material.texture, uv);
  }
  if (!mesh.colors.empty()) {
    color = color.cwiseProduct(blend(mesh.colors, mesh, hit.triangle, hit.b1, hit.b2).head<3>()) / 255.0;
  }
  if (!material.emissive) {
    if (mesh.lightmap != scene::kNone) {
      const Eigen::Vector2d uv = blend(mesh.lightmap_uv, mesh, hit.triangle, hit.b1, hit.b2);
      color = 2.0 * color.cwiseProduct(sample(mesh.lightmap, 0, uv, kLightmap).head<3>());
    } else {
      color *= light(hit, ray, doubtful);
    }
  }
  return 255.0 * color.cwiseMax(0.0).cwiseMin(1.0);
}

Reference::Sample Reference::cast(const Vector& origin, const Vector& ray, double spread) const {
  constexpr double kSlack = 1e-4;
  Sample sample;
  const double zenith = render::shading::sky_weight(ray.normalized().y());
  sample.color = 255.0 * (zenith * scene_.sky.zenith + (1 - zenith) * scene_.sky.horizon).cast<double>();
  double nearest = -1;
  for (const Hit& hit : all_hits(origin, ray, kSlack, render::shading::kNearClip)) {
    const bool first = nearest < 0;
    if (!first && hit.t > nearest + 1e-3) break;
    const double least = std::min({hit.b1, hit.b2, 1 - hit.b1 - hit.b2});
    if (is_hole(hit, sample.doubtful)) continue;
    if (!first || least < kSlack) {
      sample.doubtful = true;
      if (!first) continue;
    }
    nearest = hit.t;
    sample.depth = hit.t;
    sample.instance = hit.instance->id;
    sample.color = shade(hit, ray, spread, sample.doubtful);
  }
  return sample;
}

}  // namespace wiw::testing
