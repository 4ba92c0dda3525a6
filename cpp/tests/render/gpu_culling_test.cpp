// SPDX-License-Identifier: Apache-2.0
#include <doctest/doctest.h>

#include <algorithm>
#include <array>

#include "render/furnished.hpp"
#include "render/scenes.hpp"
#include "wiw/core/rng.hpp"
#include "wiw/render/gpu/draw_list.hpp"
#include "wiw/render/gpu/frustum.hpp"

using namespace wiw;
using namespace wiw::render;
using namespace wiw::render::gpu;
using namespace wiw::testing;

namespace {

Eigen::Vector3f random_point(Rng& rng, double reach) {
  return Eigen::Vector3d(rng.uniform(-reach, reach), rng.uniform(-reach, reach), rng.uniform(-reach, reach))
      .cast<float>();
}

/// Whether the view's own projection puts a point into the picture.
bool in_picture(const ViewBlock& view, const Eigen::Vector3f& point) {
  const Eigen::Vector3f offset = point - view.eye.head<3>();
  const float depth = -view.back.head<3>().dot(offset);
  const float x = view.projection[0] * view.right.head<3>().dot(offset) - depth * view.projection[2];
  const float y = view.projection[1] * view.up.head<3>().dot(offset) - depth * view.projection[3];
  return depth > view.lens[0] && std::abs(x) < depth && std::abs(y) < depth;
}

}  // namespace

TEST_CASE("chunks hold every triangle of a mesh once, are small, and their boxes enclose them") {
  SceneBuilder builder;
  builder.add_instance(make_sphere(1.f, 120));
  builder.add_instance(make_box({0, 0, 0}, {1, 2, 3}));
  const scene::ScenePtr scene = builder.build();
  const SceneGeometry geometry = build_geometry(*scene);
  REQUIRE(geometry.meshes.size() == 2);
  CHECK(geometry.meshes[0].chunk_count > 5);
  CHECK(geometry.meshes[1].chunk_count == 1);
  std::uint32_t first_vertex = 0;
  for (std::size_t m = 0; m < 2; ++m) {
    std::vector<std::array<std::uint32_t, 3>> found;
    for (std::size_t k = 0; k < geometry.meshes[m].chunk_count; ++k) {
      const MeshChunk& chunk = geometry.chunks[geometry.meshes[m].first_chunk + k];
      CHECK(chunk.index_count <= 3 * kChunkTriangles);
      CHECK(geometry.meshes[m].box.contains(chunk.box));
      for (std::size_t i = chunk.first_index; i < chunk.first_index + chunk.index_count; i += 3) {
        found.push_back({geometry.indices[i], geometry.indices[i + 1], geometry.indices[i + 2]});
        for (const std::uint32_t vertex : found.back()) {
          CHECK(chunk.box.contains(Eigen::Map<const Eigen::Vector3f>(geometry.vertices[vertex].position)));
        }
      }
    }
    std::vector<std::array<std::uint32_t, 3>> expected;
    for (const auto& t : scene->meshes[m].triangles) {
      expected.push_back({t[0] + first_vertex, t[1] + first_vertex, t[2] + first_vertex});
    }
    std::ranges::sort(found);
    std::ranges::sort(expected);
    CHECK(found == expected);
    first_vertex += static_cast<std::uint32_t>(scene->meshes[m].positions.size());
  }
}

TEST_CASE("culling keeps every box with a point in the picture and drops most others") {
  Rng rng(fold_key({1, 2}));
  int kept = 0;
  int visible = 0;
  constexpr int kTrials = 20000;
  for (int i = 0; i < kTrials; ++i) {
    const Pose pose = look(random_point(rng, 3).cast<double>(), rng.uniform(-3, 3), rng.uniform(-1, 1));
    const Camera camera{Projection::kPerspective, {20, 30}, rng.uniform(0.5, 2.0)};
    const ViewBlock view = i % 2 == 0 ? perspective_view(pose, camera, Eigen::Vector2f(0.4f, -0.4f), 4)
                                      : face_view(pose, i % kFaces, {64, 128}, 1);
    const Eigen::Affine3f placed = Eigen::Translation3f(random_point(rng, 2)) *
                                   Eigen::AngleAxisf(1.f, random_point(rng, 1).normalized()) *
                                   Eigen::Scaling(0.5f, 1.f, 2.f);
    const Eigen::Vector3f corner = random_point(rng, 3);
    const Eigen::AlignedBox3f box(corner, corner + Eigen::Vector3f(0.3f, 0.4f, 0.5f));
    const bool may_see = Frustum(view).in_instance(placed).may_see(box);
    bool any = false;
    for (int k = 0; k < 20; ++k) {
      const Eigen::Vector3f inside =
          box.min() +
          Eigen::Vector3d(rng.uniform(), rng.uniform(), rng.uniform()).cast<float>().cwiseProduct(box.sizes());
      any = any || in_picture(view, placed * inside);
    }
    if (any) REQUIRE(may_see);
    kept += may_see;
    visible += any;
  }
  CHECK(visible > kTrials / 20);
  CHECK(kept < visible + kTrials / 10);
}

TEST_CASE("draws come near before far, cutouts last") {
  const scene::ScenePtr scene = make_furnished();
  const SceneGeometry geometry = build_geometry(*scene);
  std::vector<Eigen::Affine3f> poses;
  for (const scene::Instance& instance : scene->instances) poses.push_back(instance.T_world_instance);
  DrawList list;
  list.gather(face_view(look({0, 1, 6}, 0, 0), 0, {64, 128}, 1), *scene, geometry.meshes, geometry.chunks, poses);
  REQUIRE(list.draws().size() > 8);
  const auto cutout = [&](const Draw& draw) { return (geometry.meshes[draw.mesh].appearance & kCutout) != 0; };
  CHECK(cutout(list.draws().back()));
  for (std::size_t i = 1; i < list.draws().size(); ++i) {
    const Draw& a = list.draws()[i - 1];
    const Draw& b = list.draws()[i];
    CHECK((cutout(b) || a.distance <= b.distance));
  }
}
