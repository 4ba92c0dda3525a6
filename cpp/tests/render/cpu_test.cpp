// SPDX-License-Identifier: Apache-2.0
#include <doctest/doctest.h>
#include <sys/resource.h>
#include <unistd.h>

#include <algorithm>
#include <cmath>
#include <fstream>
#include <limits>
#include <random>

#include "render/furnished.hpp"
#include "render/scenes.hpp"
#include "wiw/core/error.hpp"
#include "wiw/render/cpu/cpu_renderer.hpp"
#include "wiw/render/cpu/embree_scene.hpp"
#include "wiw/render/cpu/record_order.hpp"

using namespace wiw;
using namespace wiw::render;
using namespace wiw::testing;

namespace {

const Camera kView{Projection::kPerspective, {150, 203}, radians(90)};
const Camera kPanorama{Projection::kEquirectangular, {91, 162}, 0.0};
const Pose kPose = look({0, 1.2, 0}, 0.4, -0.1);

bool identical(const Picture& a, const Picture& b) {
  return a.color == b.color && a.depth == b.depth && a.instance == b.instance;
}

}  // namespace

TEST_CASE("instruction sets agree: colour to a level, depth to 1e-6, ids but for silhouettes") {
  const scene::ScenePtr scene = make_furnished();
  for (const Camera& camera : {kView, kPanorama}) {
    const Picture scalar = draw(*make_cpu_renderer(scene, {}, Isa::kScalar), kPose, camera);
    for (const Isa isa : {Isa::kAvx2, Isa::kAvx512}) {
      if (isa > native_isa()) continue;
      const Picture other = draw(*make_cpu_renderer(scene, {}, isa), kPose, camera);
      std::size_t differing = 0;
      for (std::size_t i = 0; i < scalar.depth.size(); ++i) {
        const bool same = scalar.instance[i] == other.instance[i] &&
                          std::abs(scalar.depth[i] - other.depth[i]) <= 2e-6f * scalar.depth[i];
        if (!same) ++differing;
        for (std::size_t c = 3 * i; same && c < 3 * i + 3; ++c) {
          REQUIRE(std::abs(scalar.color[c] - other.color[c]) <= 1);
        }
      }
      CHECK(static_cast<double>(differing) < 5e-4 * static_cast<double>(scalar.depth.size()));
    }
  }
}

TEST_CASE("textures read by gather instructions look the same to the last bit") {
  const scene::ScenePtr scene = make_furnished();
  for (const Camera& camera : {kView, kPanorama}) {
    const Picture gathered = draw(*make_cpu_renderer(scene, {}, native_isa(), true), kPose, camera);
    CHECK(identical(gathered, draw(*make_cpu_renderer(scene, {}, native_isa(), false), kPose, camera)));
  }
}

TEST_CASE("a panorama's pixels equal a perspective's along the same rays") {
  const scene::ScenePtr scene = make_furnished();
  const auto renderer = make_cpu_renderer(scene, {});
  const Picture panorama = draw(*renderer, kPose, kPanorama);
  // One view of one pixel along each ray, as wide as the panorama's pixel, so that filtering is the same as well.
  std::vector<Pose> poses;
  std::vector<std::size_t> pixels;
  const int row = 52;
  for (int x = 0; x < kPanorama.size.width; ++x) {
    poses.push_back(Pose::Identity());
    const Eigen::Vector3d ray = pixel_ray(kPose, kPanorama, x, row);
    poses.back().linear() = Eigen::Quaterniond::FromTwoVectors(-Eigen::Vector3d::UnitZ(), ray).toRotationMatrix();
    poses.back().translation() = kPose.translation();
    pixels.push_back(panorama.at(row, x));
  }
  const double latitude = (0.5 - (row + 0.5) / kPanorama.size.height) * kPi;
  const double width = std::max(kPi / kPanorama.size.height, 2 * kPi / kPanorama.size.width * std::cos(latitude));
  const Camera pinhole{Projection::kPerspective, {1, 1}, 2 * std::atan(width / 2)};
  std::vector<std::uint8_t> color(3 * poses.size());
  std::vector<float> depth(poses.size());
  std::vector<std::uint32_t> instance(poses.size());
  renderer->render(poses, pinhole, {color.data(), depth.data(), instance.data()});
  std::size_t differing = 0;
  for (std::size_t i = 0; i < poses.size(); ++i) {
    if (instance[i] != panorama.instance[pixels[i]]) {
      ++differing;
      continue;
    }
    REQUIRE(std::abs(depth[i] - panorama.depth[pixels[i]]) < 1e-4f);
    for (std::size_t c = 0; c < 3; ++c) {
      REQUIRE(std::abs(color[3 * i + c] - panorama.color[3 * pixels[i] + c]) <= 2);
    }
  }
  CHECK(differing <= 2);
}

TEST_CASE("distant checks melt into their mean instead of aliasing") {
  SceneBuilder builder;
  scene::Material material;
  material.texture = builder.add_texture({256, 256}, checkerboard(256, 8));
  scene::Mesh floor = make_quad({-60, 0, 60}, {120, 0, 0}, {0, 0, -120}, 60.f);
  floor.material = builder.add_material(material);
  builder.add_instance(floor);
  builder.scene.materials[0].emissive = true;
  const auto renderer = make_cpu_renderer(builder.build(), {});
  constexpr int kFine = 12;  // the reference: 144 rays a pixel
  const Camera camera{Projection::kPerspective, {96, 128}, radians(80)};
  const Camera fine{Projection::kPerspective, {96 * kFine, 128 * kFine}, radians(80)};
  const Pose pose = look({0.1, 1.0, 0.2}, 0.3, 0.0);
  const Picture picture = draw(*renderer, pose, camera);
  const Picture many = draw(*renderer, pose, fine);
  double error = 0;
  double unfiltered_error = 0;
  int count = 0;
  for (int y = 52; y < 70; ++y) {  // from 20 pixels below the horizon up to 4: cells of 6 down to half a pixel
    for (int x = 0; x < 128; ++x) {
      double mean = 0;
      for (int j = 0; j < kFine; ++j) {
        for (int i = 0; i < kFine; ++i) mean += many.color[3 * many.at(y * kFine + j, x * kFine + i)];
      }
      mean /= kFine * kFine;
      error += std::abs(picture.color[3 * picture.at(y, x)] - mean);
      unfiltered_error += std::abs(many.color[3 * many.at(y * kFine + kFine / 2, x * kFine + kFine / 2)] - mean);
      ++count;
    }
  }
  // What is left is blur along the rows, the price of one isotropic footprint; there is no moire.
  CHECK(error / count < 22.0);
  CHECK(unfiltered_error > 2.5 * error);
  for (int x = 0; x < 128; ++x) CHECK(std::abs(picture.color[3 * picture.at(50, x)] - 125) < 3);  // 30 m and farther
}

TEST_CASE("several samples a pixel approach the mean over the pixel; depth and ids stay the centre's") {
  const scene::ScenePtr scene = make_furnished();
  constexpr int kFine = 8;
  const Camera camera{Projection::kPerspective, {60, 80}, radians(90)};
  const Camera fine{Projection::kPerspective, {60 * kFine, 80 * kFine}, radians(90)};
  const Picture many = draw(*make_cpu_renderer(scene, {}), kPose, fine);
  const Picture one = draw(*make_cpu_renderer(scene, {}), kPose, camera);
  double previous = std::numeric_limits<double>::infinity();
  for (const int samples : {1, 4, 16}) {
    const Picture picture = draw(*make_cpu_renderer(scene, {.samples = samples}), kPose, camera);
    CHECK(picture.depth == one.depth);
    CHECK(picture.instance == one.instance);
    double error = 0;
    for (int y = 0; y < camera.size.height; ++y) {
      for (int x = 0; x < camera.size.width; ++x) {
        double mean = 0;
        for (int j = 0; j < kFine * kFine; ++j) {
          mean += many.color[3 * many.at(y * kFine + j / kFine, x * kFine + j % kFine)];
        }
        error += std::pow(picture.color[3 * picture.at(y, x)] - mean / (kFine * kFine), 2);
      }
    }
    CHECK(error < 0.6 * previous);
    previous = error;
  }
}

TEST_CASE("moved instances look as in a scene built that way, and back again") {
  const scene::ScenePtr scene = make_furnished();
  scene::Scene changed = *scene;
  const std::vector<std::uint32_t> ids{5, kFurnishedSphere, 8, 9};
  std::vector<Eigen::Affine3f> poses;
  for (const std::uint32_t id : ids) {
    Eigen::Affine3f& pose = changed.instances[id - 1].T_world_instance;
    pose = Eigen::Translation3f(0.3f, 0.1f, -0.2f) * Eigen::AngleAxisf(0.6f, Eigen::Vector3f(1, 2, 0.5f).normalized()) *
           pose;
    if (id == 9) pose.scale(0.5f);
    poses.push_back(pose);
  }
  const auto renderer = make_cpu_renderer(scene, {});
  const auto rebuilt = make_cpu_renderer(std::make_shared<const scene::Scene>(changed), {});
  for (const Camera& camera : {kView, kPanorama}) {
    const Picture before = draw(*renderer, kPose, camera);
    const Picture wanted = draw(*rebuilt, kPose, camera);
    REQUIRE_FALSE(identical(before, wanted));
    renderer->set_poses(ids, poses);
    CHECK(identical(draw(*renderer, kPose, camera), wanted));
    std::vector<Eigen::Affine3f> home;
    for (const std::uint32_t id : ids) home.push_back(scene->instances[id - 1].T_world_instance);
    renderer->set_poses(ids, home);
    CHECK(identical(draw(*renderer, kPose, camera), before));
  }
}

TEST_CASE("a batch equals its views one by one, subsets equal the whole, and nothing is written beyond") {
  const auto renderer = make_cpu_renderer(make_furnished(), {});
  const std::vector<Pose> poses{kPose, look({1, 1, 1}, 2.0, 0.3), look({-1, 0.5, 1}, -2.0, 0.0)};
  for (const Camera& camera : {kView, kPanorama, Camera{Projection::kPerspective, {1, 1}, 1.0}}) {
    const std::size_t pixels = camera.size.pixels();
    std::vector<std::uint8_t> color(3 * 3 * pixels + 16, 201);
    std::vector<float> depth(3 * pixels + 16, -3.f);
    std::vector<std::uint32_t> instance(3 * pixels + 16, 99999);
    renderer->render(poses, camera, {color.data(), nullptr, nullptr});
    renderer->render(poses, camera, {nullptr, depth.data(), nullptr});
    renderer->render(poses, camera, {nullptr, nullptr, instance.data()});
    for (std::size_t i = 0; i < poses.size(); ++i) {
      const Picture picture = draw(*renderer, poses[i], camera);
      CHECK(std::equal(picture.color.begin(), picture.color.end(), color.begin() + static_cast<long>(3 * i * pixels)));
      CHECK(std::equal(picture.depth.begin(), picture.depth.end(), depth.begin() + static_cast<long>(i * pixels)));
      CHECK(std::equal(picture.instance.begin(), picture.instance.end(),
                       instance.begin() + static_cast<long>(i * pixels)));
    }
    for (std::size_t i = 0; i < 16; ++i) {
      CHECK(color[9 * pixels + i] == 201);
      CHECK(depth[3 * pixels + i] == -3.f);
      CHECK(instance[3 * pixels + i] == 99999);
    }
  }
}

TEST_CASE("texture coordinates that are not numbers, and triangles without area, are survived") {
  SceneBuilder builder;
  scene::Material material;
  material.texture = builder.add_texture({8, 8}, checkerboard(8, 2));
  scene::Mesh quad = make_quad({-1, -1, -2}, {2, 0, 0}, {0, 2, 0});
  std::vector<Eigen::Vector2f> uv(quad.uv.begin(), quad.uv.end());
  uv[0].x() = std::numeric_limits<float>::quiet_NaN();
  uv[1].y() = std::numeric_limits<float>::infinity();
  uv[2].x() = -1e30f;
  quad.uv = uv;
  quad.material = builder.add_material(material);
  builder.add_instance(quad);
  scene::Mesh flat = make_quad({0, 0, -1}, {1, 0, 0}, {2, 0, 0});
  flat.material = quad.material;
  builder.add_instance(flat);
  for (const Isa isa : {Isa::kScalar, Isa::kAvx2, Isa::kAvx512}) {
    if (isa > native_isa()) continue;
    const Picture picture = draw(*make_cpu_renderer(builder.build(), {}, isa), Pose::Identity(), kView);
    CHECK(picture.instance[picture.at(75, 101)] == 1);
  }
}

TEST_CASE("what cannot be drawn is refused with a typed error") {
  const scene::ScenePtr scene = make_furnished();
  const auto renderer = make_cpu_renderer(scene, {});
  std::vector<float> depth(kView.size.pixels());
  const auto render = [&](const Pose& pose, const Camera& camera) {
    renderer->render(std::span(&pose, 1), camera, {nullptr, depth.data(), nullptr});
  };
  Pose broken = Pose::Identity();
  broken.translation().x() = std::numeric_limits<double>::quiet_NaN();
  CHECK_THROWS_AS(render(broken, kView), ArgumentError);
  for (const double far : {1e19, 1e300}) {
    Pose away = Pose::Identity();
    away.translation().y() = -far;
    CHECK_THROWS_AS(render(away, kView), ArgumentError);
  }
  Pose flat = Pose::Identity();
  flat.linear().setZero();
  CHECK_THROWS_AS(render(flat, kView), ArgumentError);
  CHECK_THROWS_AS(render(kPose, {Projection::kPerspective, {0, 10}, 1.0}), ArgumentError);
  CHECK_THROWS_AS(render(kPose, {Projection::kPerspective, {10, 10}, kPi}), ArgumentError);
  CHECK_THROWS_AS(render(kPose, {Projection::kPerspective, {10, 10}, 0.0}), ArgumentError);
  CHECK_THROWS_AS(make_cpu_renderer(scene, {.samples = 3}), ArgumentError);
  CHECK_THROWS_AS(make_cpu_renderer(SceneBuilder().build(), {}), ArgumentError);
  const std::uint32_t unknown = 1000;
  const Eigen::Affine3f here = Eigen::Affine3f::Identity();
  CHECK_THROWS_AS(renderer->set_poses(std::span(&unknown, 1), std::span(&here, 1)), ArgumentError);
  CHECK_THROWS_AS(renderer->set_poses({}, std::span(&here, 1)), ArgumentError);
}

TEST_CASE("a large mesh whose triangles come in any order looks like the one in order") {
  // Waves of 135,200 triangles, no two of them in one place, whose texture tells every one of them from the others.
  constexpr int kCells = 260;
  scene::Mesh ordered;
  std::vector<Eigen::Vector3f> positions, normals;
  std::vector<Eigen::Vector2f> uv;
  std::vector<scene::Triangle> triangles;
  for (int z = 0; z <= kCells; ++z) {
    for (int x = 0; x <= kCells; ++x) {
      const float u = static_cast<float>(x) / kCells, v = static_cast<float>(z) / kCells;
      positions.emplace_back(6.f * u - 3.f, 0.1f * std::sin(20.f * u) * std::cos(17.f * v), 6.f * v - 3.f);
      normals.emplace_back(Eigen::Vector3f(u - 0.5f, 1.f, v - 0.5f).normalized());
      uv.emplace_back(u, v);
    }
  }
  for (std::uint32_t z = 0; z < kCells; ++z) {
    for (std::uint32_t x = 0; x < kCells; ++x) {
      const std::uint32_t a = z * (kCells + 1) + x, b = a + 1, c = a + kCells + 1, d = c + 1;
      triangles.emplace_back(a, c, b);
      triangles.emplace_back(b, c, d);
    }
  }
  SceneBuilder builder;
  ordered.material = builder.add_material({.texture = builder.add_texture({64, 64}, checkerboard(64, 64))});
  ordered.positions = positions, ordered.normals = normals, ordered.uv = uv, ordered.triangles = triangles;
  scene::Mesh shuffled = ordered;
  std::shuffle(triangles.begin(), triangles.end(), std::mt19937(3));
  shuffled.triangles = triangles;
  REQUIRE(cpu::spatial_order(ordered).empty());
  std::vector<std::uint32_t> places = cpu::spatial_order(shuffled);
  std::sort(places.begin(), places.end());
  REQUIRE(places.size() == triangles.size());
  for (std::uint32_t i = 0; i < places.size(); ++i) REQUIRE(places[i] == i);

  SceneBuilder other = builder;
  builder.add_instance(ordered);
  other.add_instance(shuffled);
  const auto first = make_cpu_renderer(builder.build(), {}), second = make_cpu_renderer(other.build(), {});
  const Pose pose = look({0.1, 1.5, 0.2}, 0.3, -0.9);
  const Picture in_order = draw(*first, pose, kView);
  const auto differing = [&](const Picture& picture) {
    std::size_t count = 0;
    for (std::size_t i = 0; i < picture.color.size(); ++i) count += std::abs(picture.color[i] - in_order.color[i]) > 1;
    return static_cast<double>(count) / static_cast<double>(picture.color.size());
  };
  CHECK(differing(draw(*second, pose, kView)) < 1e-3);  // a ray through an edge hits either neighbour
  const std::uint32_t id = 1;
  Eigen::Affine3f turned = Eigen::Affine3f::Identity();
  turned.rotate(Eigen::AngleAxisf(0.5f, Eigen::Vector3f::UnitY()));
  for (const auto& renderer : {first, second}) renderer->set_poses(std::span(&id, 1), std::span(&turned, 1));
  const Picture moved = draw(*first, pose, kView);
  CHECK(differing(moved) > 0.1);
  const Picture moved_too = draw(*second, pose, kView);
  std::size_t unlike = 0;
  for (std::size_t i = 0; i < moved.color.size(); ++i) unlike += std::abs(moved.color[i] - moved_too.color[i]) > 1;
  CHECK(static_cast<double>(unlike) < 1e-3 * static_cast<double>(moved.color.size()));
}

TEST_CASE("an empty batch and no outputs are no work") {
  const auto renderer = make_cpu_renderer(make_furnished(), {});
  float depth = 5.f;
  renderer->render({}, kView, {nullptr, &depth, nullptr});
  renderer->render(std::span(&kPose, 1), kView, {});
  CHECK(depth == 5.f);
}

// The sanitisers' own memory does not stand a limit.
#if !defined(__SANITIZE_ADDRESS__) && !defined(__SANITIZE_THREAD__)
namespace {

std::size_t mapped_bytes() {
  std::size_t pages = 0;
  std::ifstream("/proc/self/statm") >> pages;
  return pages * static_cast<std::size_t>(sysconf(_SC_PAGESIZE));
}

constexpr std::size_t kMegabyte = 1 << 20;

/// Limits the addresses of the process while it lives.
class MemoryLimit {
 public:
  explicit MemoryLimit(std::size_t bytes) {
    getrlimit(RLIMIT_AS, &free_);
    const rlimit tight{bytes, free_.rlim_max};
    setrlimit(RLIMIT_AS, &tight);
  }
  ~MemoryLimit() { setrlimit(RLIMIT_AS, &free_); }
  MemoryLimit(const MemoryLimit&) = delete;
  MemoryLimit& operator=(const MemoryLimit&) = delete;

 private:
  rlimit free_{};
};

}  // namespace

TEST_CASE("small scenes come and go where Embree's caches would have no room") {
  const scene::ScenePtr scene = make_furnished();
  const cpu::ShadingScene shading(*scene);
  const MemoryLimit limit(mapped_bytes() + 60 * kMegabyte);
  for (int i = 0; i < 20; ++i) CHECK_NOTHROW(cpu::EmbreeScene(*scene, shading, Isa::kScalar));
}

TEST_CASE("a scene that memory ends for leaves nothing in Embree") {
  SceneBuilder builder;
  // Embree copies the first, and has no room for the second.
  for (const std::size_t vertices : {1000000, 4000000}) {
    scene::Mesh mesh = make_quad({-1, -1, -2}, {2, 0, 0}, {0, 2, 0});
    std::vector<Eigen::Vector3f> positions(mesh.positions.begin(), mesh.positions.end());
    positions.resize(vertices, Eigen::Vector3f::Zero());
    mesh.positions = positions;
    builder.add_instance(mesh);
  }
  const scene::ScenePtr scene = builder.build();
  const cpu::ShadingScene shading(*scene);
  const std::size_t before = mapped_bytes();
  const MemoryLimit limit(before + 40 * kMegabyte);
  int refused = 0;
  for (int i = 0; i < 6; ++i) {
    try {
      const cpu::EmbreeScene embree(*scene, shading, Isa::kScalar);
    } catch (const Error&) {
      ++refused;
    }
  }
  CHECK(refused == 6);
  CHECK(mapped_bytes() < before + 24 * kMegabyte);
}
#endif
