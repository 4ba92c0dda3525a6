// SPDX-License-Identifier: Apache-2.0
#include "render/reference.hpp"

#include <doctest/doctest.h>

#include <cmath>

#include "render/furnished.hpp"
#include "render/scenes.hpp"
#include "wiw/render/cpu/cpu_renderer.hpp"

using namespace wiw;
using namespace wiw::render;
using namespace wiw::testing;

namespace {

const Camera kCameras[] = {{Projection::kPerspective, {37, 49}, radians(100)},
                           {Projection::kEquirectangular, {30, 53}, 0.0}};

double spread_of(const Camera& camera, int y) {
  if (camera.projection == Projection::kPerspective) return 1.0 / Intrinsics{camera.size, camera.hfov}.focal();
  const double latitude = (0.5 - (y + 0.5) / camera.size.height) * kPi;
  return std::max(kPi / camera.size.height, 2 * kPi / camera.size.width * std::cos(latitude));
}

std::vector<Reference::Sample> truth_of(const Reference& reference, const Pose& pose, const Camera& camera) {
  std::vector<Reference::Sample> samples;
  for (int y = 0; y < camera.size.height; ++y) {
    for (int x = 0; x < camera.size.width; ++x) {
      samples.push_back(reference.cast(pose.translation(), pixel_ray(pose, camera, x, y), spread_of(camera, y)));
    }
  }
  return samples;
}

/// Compares a picture with the slow twin pixel by pixel; returns the share of pixels that could be compared.
double compare(const Picture& picture, const std::vector<Reference::Sample>& truth) {
  std::size_t compared = 0;
  for (std::size_t i = 0; i < truth.size(); ++i) {
    if (truth[i].doubtful) continue;
    ++compared;
    CAPTURE(i);
    REQUIRE(picture.instance[i] == truth[i].instance);
    REQUIRE(std::abs(picture.depth[i] - truth[i].depth) < 1e-4);
    for (std::size_t c = 0; c < 3; ++c) {
      REQUIRE(std::abs(picture.color[3 * i + c] - truth[i].color[static_cast<Eigen::Index>(c)]) < 1.0);
    }
  }
  return static_cast<double>(compared) / static_cast<double>(truth.size());
}

void check_all_sets(const scene::ScenePtr& scene, const Reference& reference, const Pose& pose, const Camera& camera) {
  const auto truth = truth_of(reference, pose, camera);
  for (const Isa isa : {Isa::kScalar, Isa::kAvx2, Isa::kAvx512}) {
    if (isa > native_isa()) continue;
    CHECK(compare(draw(*make_cpu_renderer(scene, {}, isa), pose, camera), truth) > 0.85);
  }
}

}  // namespace

TEST_CASE("every kind of surface is shaded as the slow twin shades it, with every instruction set") {
  const scene::ScenePtr scene = make_furnished();
  const Reference reference(*scene);
  for (const Camera& camera : kCameras) {
    for (const Pose& pose : {look({0, 1.2, 0}, 0.4, 0.0), look({0.6, 1.0, 0.4}, 3.3, -0.5)}) {
      check_all_sets(scene, reference, pose, camera);
    }
  }
}

TEST_CASE("textures go on beyond their edges as their sampling says, from near by and from afar") {
  const scene::ScenePtr scene = make_tiled();
  const Reference reference(*scene);
  for (const double distance : {0.4, 6.0}) {
    const Camera camera{Projection::kPerspective, {37, 49}, distance < 1 ? 2.0 : 0.5};
    check_all_sets(scene, reference, look({0, 0.9, distance}, 0.0, 0.0), camera);
  }
}

TEST_CASE("light and shadows of a sun are those of the slow twin, from high, and grazing") {
  for (const Eigen::Vector3f& direction : {Eigen::Vector3f(0.48f, 0.8f, 0.36f), Eigen::Vector3f(0.8f, 0.08f, 0.6f)}) {
    scene::Scene changed = *make_sunny();
    changed.sun->direction = direction.normalized();
    const auto scene = std::make_shared<const scene::Scene>(changed);
    const Reference reference(*scene);
    for (const Camera& camera : kCameras) check_all_sets(scene, reference, look({0, 1.2, 0}, 0.4, -0.2), camera);
  }
}

TEST_CASE("a stamp of every kind of surface, small enough for an emulated processor") {
  const scene::ScenePtr scene = make_furnished();
  const Camera camera{Projection::kPerspective, {9, 14}, 1.7};
  check_all_sets(scene, Reference(*scene), look({0, 1.2, 0}, 0.4, 0.0), camera);
  const scene::ScenePtr sunny = make_sunny();
  check_all_sets(sunny, Reference(*sunny), look({0, 1.2, 0}, 0.4, 0.0), camera);
}
