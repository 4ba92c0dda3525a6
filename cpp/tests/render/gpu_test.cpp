// SPDX-License-Identifier: Apache-2.0
#include <doctest/doctest.h>
#include <sys/wait.h>
#include <unistd.h>

#include <cmath>
#include <fstream>
#include <optional>
#include <thread>

#include "render/furnished.hpp"
#include "render/scenes.hpp"
#include "wiw/core/error.hpp"
#include "wiw/render/cpu/cpu_renderer.hpp"
#include "wiw/render/gpu/gpu_renderer.hpp"

using namespace wiw;
using namespace wiw::render;
using namespace wiw::testing;

namespace {

const Camera kView{Projection::kPerspective, {240, 320}, radians(90)};
const Camera kPanorama{Projection::kEquirectangular, {144, 256}, 0.0};
const std::vector<Pose> kPoses{look({0, 1.2, 0}, 0.4, 0.0), look({-1.2, 1.6, 1.4}, -0.8, -0.4),
                               look({1.5, 0.8, 1.0}, 2.5, 0.3)};

std::shared_ptr<Renderer> gpu(const scene::ScenePtr& scene, int samples = 1) {
  return make_gpu_renderer(scene, {.samples = samples});
}

/// Says why and returns false where no OpenGL context can be had.
bool available() {
  static const std::optional<std::string> reason = []() -> std::optional<std::string> {
    try {
      gpu(make_furnished());
      return {};
    } catch (const BackendError& error) {
      return error.what();
    }
  }();
  if (reason) MESSAGE("skipped: " << *reason);
  return !reason;
}

std::vector<bool> near_silhouette(const Picture& a) {
  std::vector<bool> edge(a.size.pixels(), false);
  for (int y = 0; y < a.size.height; ++y) {
    for (int x = 0; x < a.size.width; ++x) {
      for (const auto& [dy, dx] : {std::pair{0, 1}, {1, 0}}) {
        if (y + dy >= a.size.height || x + dx >= a.size.width) continue;
        const std::size_t i = a.at(y, x);
        const std::size_t j = a.at(y + dy, x + dx);
        if (a.instance[i] != a.instance[j] || std::abs(a.depth[i] - a.depth[j]) > 0.1f) edge[i] = edge[j] = true;
      }
    }
  }
  return edge;
}

struct Difference {
  double ids = 0;    // share of pixels
  double depth = 0;  // share of pixels away from silhouettes that differ by over 1 cm
  double color = 0;  // mean absolute grey levels
};

Difference compare(const Picture& a, const Picture& b) {
  Difference result;
  const std::vector<bool> edge = near_silhouette(a);
  for (std::size_t i = 0; i < a.size.pixels(); ++i) {
    result.ids += a.instance[i] != b.instance[i];
    result.depth += !edge[i] && std::abs(a.depth[i] - b.depth[i]) > 0.01f;
    for (std::size_t c = 3 * i; c < 3 * i + 3; ++c) result.color += std::abs(a.color[c] - b.color[c]) / 3.0;
  }
  const auto pixels = static_cast<double>(a.size.pixels());
  return {result.ids / pixels, result.depth / pixels, result.color / pixels};
}

bool equal(const Picture& a, const Picture& b) {
  return a.color == b.color && a.depth == b.depth && a.instance == b.instance;
}

std::size_t resident_kilobytes() {
  std::ifstream statm("/proc/self/statm");
  std::size_t total = 0;
  std::size_t resident = 0;
  statm >> total >> resident;
  return resident * static_cast<std::size_t>(sysconf(_SC_PAGESIZE)) / 1024;
}

}  // namespace

TEST_CASE("gpu: depth and ids of a box room are exact in both projections") {
  if (!available()) return;
  const Eigen::Vector3d low(-2.0, 0.0, -3.5);
  const Eigen::Vector3d high(2.5, 2.75, 3.0);
  const auto renderer = gpu(make_room(low.cast<float>(), high.cast<float>()));
  for (const Camera& camera : {kView, kPanorama}) {
    const Pose pose = look({0.3, 1.0, -0.4}, 0.7, 0.2);
    const Picture picture = draw(*renderer, pose, camera);
    std::size_t wrong_ids = 0;
    for (int y = 0; y < camera.size.height; ++y) {
      for (int x = 0; x < camera.size.width; ++x) {
        const Eigen::Vector3d ray = pixel_ray(pose, camera, x, y);
        double depth = 1e9;
        std::uint32_t id = 0;
        for (int axis = 0; axis < 3; ++axis) {
          const double wall = (ray[axis] > 0 ? high : low)[axis];
          const double t = (wall - pose.translation()[axis]) / ray[axis];
          if (t >= depth) continue;
          depth = t;
          id = static_cast<std::uint32_t>(2 * axis + (ray[axis] > 0 ? 2 : 1));
        }
        const std::size_t i = picture.at(y, x);
        if (picture.instance[i] != id) {
          ++wrong_ids;  // the nearest texel of a face may show the wall beyond a corner
        } else {
          REQUIRE(std::abs(picture.depth[i] - depth) < 2e-4);
        }
      }
    }
    const bool panorama = camera.projection == Projection::kEquirectangular;
    CHECK(static_cast<double>(wrong_ids) <= (panorama ? 0.005 : 0.0001) * static_cast<double>(camera.size.pixels()));
  }
}

TEST_CASE("gpu: pictures agree with the ray caster's") {
  if (!available()) return;
  const scene::ScenePtr scene = make_furnished();
  for (const int samples : {1, 4}) {
    const auto renderer = gpu(scene, samples);
    const auto reference = make_cpu_renderer(scene, {.samples = samples});
    for (const Camera& camera : {kView, kPanorama}) {
      const bool panorama = camera.projection == Projection::kEquirectangular;
      for (const Pose& pose : kPoses) {
        const Difference difference = compare(draw(*reference, pose, camera), draw(*renderer, pose, camera));
        CAPTURE(samples);
        CAPTURE(panorama);
        CHECK(difference.ids < (panorama ? 0.005 : 0.001));
        CHECK(difference.depth < 0.001);
        CHECK(difference.color < (panorama ? 2.5 : 0.5));
      }
    }
  }
}

TEST_CASE("gpu: textures go on beyond their edges as the ray caster's do") {
  if (!available()) return;
  const scene::ScenePtr scene = make_tiled();
  const auto renderer = gpu(scene, 1);
  const auto reference = make_cpu_renderer(scene, {});
  for (const double distance : {0.4, 6.0}) {
    const Camera camera{Projection::kPerspective, {120, 160}, distance < 1 ? 2.0 : 0.5};
    const Pose pose = look({0, 0.9, distance}, 0.0, 0.0);
    const Difference difference = compare(draw(*reference, pose, camera), draw(*renderer, pose, camera));
    CHECK(difference.ids < 0.002);
    CHECK(difference.color < 0.5);
  }
}

TEST_CASE("gpu: shadows of the sun agree with the ray caster's, also after a move") {
  if (!available()) return;
  const std::uint32_t id = kFurnishedSphere;
  const Eigen::Affine3f moved = Eigen::Translation3f(0.1f, 0.9f, -1.3f) * Eigen::Scaling(0.7f);
  for (const int samples : {1, 4}) {
    const auto renderer = gpu(make_sunny(), samples);
    const auto reference = make_cpu_renderer(make_sunny(), {.samples = samples});
    for (const Camera& camera : {kView, kPanorama}) {
      const bool panorama = camera.projection == Projection::kEquirectangular;
      for (const Pose& pose : kPoses) {
        const Difference difference = compare(draw(*reference, pose, camera), draw(*renderer, pose, camera));
        CAPTURE(samples);
        CAPTURE(panorama);
        CHECK(difference.color < (panorama ? 2.5 : 0.6));
      }
      for (const auto& each : {renderer, reference}) each->set_poses(std::span(&id, 1), std::span(&moved, 1));
    }
  }
}

TEST_CASE("gpu: a batch equals its views one by one, and any subset of outputs the whole") {
  if (!available()) return;
  const auto renderer = gpu(make_furnished());
  for (const Camera& camera : {kView, kPanorama}) {
    const std::size_t pixels = camera.size.pixels();
    std::vector<std::uint8_t> color(3 * pixels * kPoses.size());
    std::vector<float> depth(pixels * kPoses.size());
    std::vector<std::uint32_t> instance(pixels * kPoses.size());
    renderer->render(kPoses, camera, {.color = color.data()});
    renderer->render(kPoses, camera, {.depth = depth.data()});
    renderer->render(kPoses, camera, {.instance = instance.data()});
    for (std::size_t i = 0; i < kPoses.size(); ++i) {
      const Picture single = draw(*renderer, kPoses[i], camera);
      CHECK(std::equal(single.color.begin(), single.color.end(), color.begin() + static_cast<long>(3 * i * pixels)));
      CHECK(std::equal(single.depth.begin(), single.depth.end(), depth.begin() + static_cast<long>(i * pixels)));
      CHECK(
          std::equal(single.instance.begin(), single.instance.end(), instance.begin() + static_cast<long>(i * pixels)));
    }
  }
}

TEST_CASE("gpu: more views than one read-back holds") {
  if (!available()) return;
  const auto renderer = gpu(make_furnished());
  const Camera camera{Projection::kPerspective, {1024, 1024}, radians(70)};  // eight to a read-back
  std::vector<Pose> poses(9, kPoses[0]);
  poses.back() = kPoses[1];
  std::vector<float> depth(camera.size.pixels() * poses.size());
  renderer->render(poses, camera, {.depth = depth.data()});
  const Picture last = draw(*renderer, poses.back(), camera);
  CHECK(std::equal(last.depth.rbegin(), last.depth.rend(), depth.rbegin()));
}

TEST_CASE("gpu: moved instances are drawn where a scene built that way has them") {
  if (!available()) return;
  const Eigen::Affine3f moved = Eigen::Translation3f(0.4f, 1.1f, -1.2f) *
                                Eigen::AngleAxisf(0.7f, Eigen::Vector3f(1, 2, 3).normalized()) *
                                Eigen::Scaling(1.5f, 0.5f, 1.f);
  const std::uint32_t id = kFurnishedSphere;
  const auto renderer = gpu(make_furnished());
  const Picture before = draw(*renderer, kPoses[0], kView);
  renderer->set_poses(std::span(&id, 1), std::span(&moved, 1));
  scene::Scene rebuilt = *make_furnished();
  rebuilt.instances[id - 1].T_world_instance = moved;
  const Picture after = draw(*renderer, kPoses[0], kView);
  CHECK(equal(after, draw(*gpu(std::make_shared<const scene::Scene>(rebuilt)), kPoses[0], kView)));
  CHECK_FALSE(equal(after, before));

  const std::uint32_t unknown = 999;
  CHECK_THROWS_AS(renderer->set_poses(std::span(&unknown, 1), std::span(&moved, 1)), ArgumentError);
}

TEST_CASE("gpu: one renderer used from several threads") {
  if (!available()) return;
  const auto renderer = gpu(make_furnished());
  const Picture expected = draw(*renderer, kPoses[1], kView);
  std::vector<Picture> pictures(4);
  std::vector<std::thread> threads;
  threads.reserve(pictures.size());
  for (Picture& picture : pictures) {
    threads.emplace_back([&] { picture = draw(*renderer, kPoses[1], kView); });
  }
  for (std::thread& thread : threads) thread.join();
  for (const Picture& picture : pictures) CHECK(equal(picture, expected));
}

TEST_CASE("gpu: a forked child is refused with the remedy instead of hanging") {
  if (!available()) return;
  const auto renderer = gpu(make_furnished());
  const pid_t child = fork();
  if (child == 0) {
    const auto refused = [](auto&& use) {
      try {
        use();
      } catch (const BackendError& error) {
        return std::string(error.what()).find("spawn") != std::string::npos;
      }
      return false;
    };
    const bool both = refused([&] { draw(*renderer, kPoses[0], kView); }) && refused([] { gpu(make_furnished()); });
    _exit(both ? 0 : 1);
  }
  int status = 0;
  waitpid(child, &status, 0);
  CHECK(WIFEXITED(status));
  CHECK(WEXITSTATUS(status) == 0);
}

TEST_CASE("gpu: switching scenes 200 times keeps no memory") {
  if (!available()) return;
  const Camera camera{Projection::kPerspective, {32, 32}, radians(90)};
  std::size_t settled = 0;
  for (int i = 0; i < 200; ++i) {
    if (i == 40) settled = resident_kilobytes();
    draw(*gpu(make_furnished()), kPoses[0], camera);
  }
  // One scene of these holds about 1.5 MB; 160 leaked ones would be far beyond the limit.
  CHECK(resident_kilobytes() < settled + 20 * 1024);
}
