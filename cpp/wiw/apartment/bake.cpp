// SPDX-License-Identifier: Apache-2.0
// From a draft to the finished scene: light to bytes, objects to instances.
#include <cmath>

#include "wiw/apartment/draft.hpp"
#include "wiw/apartment/lighting.hpp"

namespace wiw::apartment {

namespace {

using Bytes4 = Eigen::Matrix<std::uint8_t, 4, 1>;

/// Light as the display shows it, halved (see Material): a gentle shoulder keeps bright spots from clipping.
Rgb to_display(const Rgb& light) {
  const Rgb exposed = 1.18f * light;
  const Rgb shown = (exposed.array() * (1.f + exposed.array() / 9.f) / (1.f + 0.35f * exposed.array())).matrix();
  return 0.5f * to_encoded(shown);
}

std::uint8_t to_byte(float value) {
  return static_cast<std::uint8_t>(std::lround(255.f * std::min(1.f, std::max(0.f, value))));
}

/// Mean of the kPhases parts of the sampling pattern, which tile a chart: a 4 x 4 box, shrunk at the chart's edges.
std::vector<Rgb> smoothed(const std::vector<Rgb>& light, const ChartPlace& place) {
  const auto at = [&](const std::vector<Rgb>& from, int row, int column) -> const Rgb& {
    return from[static_cast<std::size_t>(row * place.columns + column)];
  };
  const std::vector<Rgb> source(light.begin() + static_cast<std::ptrdiff_t>(place.first),
                                light.begin() + static_cast<std::ptrdiff_t>(place.first) + place.columns * place.rows);
  constexpr std::array<float, 5> kWeights{0.125f, 0.25f, 0.25f, 0.25f, 0.125f};
  const auto pass = [&](const std::vector<Rgb>& from, bool along_rows) {
    std::vector<Rgb> to(from.size());
    for (int row = 0; row < place.rows; ++row) {
      for (int column = 0; column < place.columns; ++column) {
        Rgb sum = Rgb::Zero();
        float total = 0.f;
        for (int k = -2; k <= 2; ++k) {
          const int r = along_rows ? row : row + k, c = along_rows ? column + k : column;
          if (r < 0 || c < 0 || r >= place.rows || c >= place.columns) continue;
          sum += kWeights[static_cast<std::size_t>(k + 2)] * at(from, r, c);
          total += kWeights[static_cast<std::size_t>(k + 2)];
        }
        to[static_cast<std::size_t>(row * place.columns + column)] = sum / total;
      }
    }
    return to;
  };
  return pass(pass(source, true), false);
}

scene::Texture make_lightmap(const Atlas& atlas, const std::vector<Rgb>& light, ThreadPool& pool) {
  std::vector<std::uint8_t> rgba(4 * atlas.size.pixels(), 128);
  pool.parallel_for(atlas.places.size(), [&](std::size_t i) {
    const ChartPlace& place = atlas.places[i];
    const std::vector<Rgb> texels = smoothed(light, place);
    for (int row = -Atlas::kPadding; row < place.rows + Atlas::kPadding; ++row) {
      for (int column = -Atlas::kPadding; column < place.columns + Atlas::kPadding; ++column) {
        const int r = std::clamp(row, 0, place.rows - 1), c = std::clamp(column, 0, place.columns - 1);
        const Rgb shown = to_display(texels[static_cast<std::size_t>(r * place.columns + c)]);
        const auto pixel = static_cast<std::size_t>((place.y + row) * atlas.size.width + place.x + column);
        for (int channel = 0; channel < 3; ++channel)
          rgba[4 * pixel + static_cast<std::size_t>(channel)] = to_byte(shown[channel]);
        rgba[4 * pixel + 3] = 255;
      }
    }
  });
  return {"lightmap", atlas.size, std::move(rgba)};
}

std::vector<Vec2> texture_uv(const Submesh& part, const Finish& finish) {
  std::vector<Vec2> uv;
  uv.reserve(part.uv.size());
  for (const Vec2& metres : part.uv) uv.emplace_back(metres.cwiseQuotient(finish.metres));
  return uv;
}

/// Builds the scene's meshes and instances; vertex-lit parts take their light in the order of the solver's samples.
class InstanceBaker {
 public:
  InstanceBaker(const Draft& draft, scene::Scene& scene) : draft_(draft), scene_(scene) {}
  InstanceBaker(const Draft& draft, scene::Scene& scene, const Atlas& atlas, const std::vector<Rgb>& light)
      : draft_(draft), scene_(scene), atlas_(&atlas), light_(&light), next_(atlas.texels) {}

  void add(const Object& object) {
    scene::Instance instance;
    instance.id = static_cast<std::uint32_t>(scene_.instances.size() + 1);
    instance.category = category(object.category);
    instance.name = object.name;
    instance.T_world_instance = object.pose;
    instance.attributes = object.attributes;
    if (object.room != kOutside)
      instance.attributes["room"] = draft_.plan.rooms[static_cast<std::size_t>(object.room)].name;
    for (const Panel& panel : object.panels) instance.meshes.push_back(add_panel(panel));
    for (const Submesh& part : object.shape.parts()) instance.meshes.push_back(add_part(part));
    scene_.instances.push_back(std::move(instance));
  }

 private:
  std::int32_t category(const std::string& name) {
    const auto found = std::find(scene_.categories.begin(), scene_.categories.end(), name);
    if (found != scene_.categories.end()) return static_cast<std::int32_t>(found - scene_.categories.begin());
    scene_.categories.push_back(name);
    return static_cast<std::int32_t>(scene_.categories.size() - 1);
  }

  scene::Mesh to_mesh(const Submesh& part) const {
    scene::Mesh mesh;
    mesh.positions = part.positions;
    mesh.normals = part.normals;
    if (light_ != nullptr) mesh.uv = texture_uv(part, draft_.materials.finish(part.material));
    mesh.triangles = part.triangles;
    mesh.material = static_cast<std::int32_t>(part.material);
    return mesh;
  }

  std::uint32_t add_panel(const Panel& panel) {
    scene::Mesh mesh = to_mesh(panel.part);
    if (light_ == nullptr) return store(std::move(mesh));
    std::vector<Vec2> uv;
    uv.reserve(panel.part.positions.size());
    for (const Vec3& position : panel.part.positions)
      uv.push_back(atlas_->uv(draft_.charts[panel.chart], atlas_->places[panel.chart], position));
    mesh.lightmap_uv = std::move(uv);
    mesh.lightmap = static_cast<std::int32_t>(scene_.textures.size()) - 2;
    return store(std::move(mesh));
  }

  /// Vertex colours hold half the light, since they cannot exceed 1; the full-bright lightmap doubles it.
  std::uint32_t add_part(const Submesh& part) {
    scene::Mesh mesh = to_mesh(part);
    if (light_ == nullptr) {
      std::vector<Bytes4> tints;
      tints.reserve(part.tint.size());
      for (const Rgb& tint : part.tint)
        tints.emplace_back(to_byte(tint.x()), to_byte(tint.y()), to_byte(tint.z()), std::uint8_t{255});
      mesh.colors = std::move(tints);
      return store(std::move(mesh));
    }
    const bool emissive = draft_.materials.finish(part.material).emissive;
    std::vector<Bytes4> colors;
    for (const Rgb& tint : part.tint) {
      const Rgb light = to_display((*light_)[next_++]);
      const Rgb shown = emissive ? tint : Rgb(tint.cwiseProduct(light));
      colors.emplace_back(to_byte(shown.x()), to_byte(shown.y()), to_byte(shown.z()), std::uint8_t{255});
    }
    mesh.colors = std::move(colors);
    if (!emissive) {
      mesh.lightmap = static_cast<std::int32_t>(scene_.textures.size()) - 1;
      mesh.lightmap_uv = std::vector<Vec2>(part.positions.size(), Vec2(0.5f, 0.5f));
    }
    return store(std::move(mesh));
  }

  std::uint32_t store(scene::Mesh mesh) {
    scene_.meshes.push_back(std::move(mesh));
    return static_cast<std::uint32_t>(scene_.meshes.size() - 1);
  }

  const Draft& draft_;
  scene::Scene& scene_;
  const Atlas* atlas_ = nullptr;  // neither atlas nor light: an outline
  const std::vector<Rgb>* light_ = nullptr;
  std::size_t next_ = 0;
};

void describe(scene::Scene& scene, const Draft& draft) {
  scene.name = "apartment " + split_name(draft.split) + " " + std::to_string(draft.seed);
  scene.attributes = {{"split", split_name(draft.split)},
                      {"seed", std::to_string(draft.seed)},
                      {"layout", draft.plan.signature},
                      {"area_m2", std::to_string(static_cast<int>(std::lround(draft.plan.area())))}};
  for (const std::string& edit : draft.edits) {
    scene.name += (scene.attributes.contains("edits") ? "&" : "?") + edit;
    std::string& edits = scene.attributes["edits"];
    edits += (edits.empty() ? "" : "&") + edit;
  }
  for (const PlanRoom& room : draft.plan.rooms) {
    const Rect r = room.inside();
    scene.rooms.push_back({room.name, room_name(room.type),
                           Eigen::AlignedBox3f(Vec3(r.x0, 0, r.z0), Vec3(r.x1, draft.plan.ceiling, r.z1))});
  }
}

}  // namespace

scene::Scene bake(const Draft& draft, ThreadPool& pool, const BounceRays& rays) {
  scene::Scene scene;
  describe(scene, draft);
  scene.textures = draft.materials.draw_textures(pool);
  scene.materials = draft.materials.to_materials();
  const Atlas atlas(draft.charts);
  const LightSolver solver(draft, atlas, scene.textures, rays);
  const std::vector<Rgb> light = solver.solve(pool);
  scene.textures.push_back(make_lightmap(atlas, light, pool));
  scene.textures.push_back({"full light", {4, 4}, std::vector<std::uint8_t>(64, 255)});
  InstanceBaker assembler(draft, scene, atlas, light);
  for (const Object& object : draft.objects) assembler.add(object);
  return scene;
}

scene::Scene outline(const Draft& draft) {
  scene::Scene scene;
  describe(scene, draft);
  scene.materials = draft.materials.to_materials();
  for (scene::Material& material : scene.materials) material.texture = scene::kNone;
  InstanceBaker assembler(draft, scene);
  for (const Object& object : draft.objects) assembler.add(object);
  return scene;
}

}  // namespace wiw::apartment
