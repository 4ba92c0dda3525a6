// SPDX-License-Identifier: Apache-2.0
#include <doctest/doctest.h>

#include <cmath>

#include "render/scenes.hpp"
#include "wiw/render/cpu/cpu_renderer.hpp"
#include "wiw/render/shading.hpp"

using namespace wiw;
using namespace wiw::render;
using namespace wiw::testing;

namespace {

const Camera kCameras[] = {{Projection::kPerspective, {121, 163}, radians(90)},
                           {Projection::kPerspective, {64, 96}, radians(50)},
                           {Projection::kEquirectangular, {90, 170}, 0.0}};
const Eigen::Vector3d kLow(-2.0, 0.0, -3.5);
const Eigen::Vector3d kHigh(2.5, 2.75, 3.0);

struct Exit {
  double depth = 0;
  std::uint32_t id = 0;
  double margin = 0;  // how much farther the next wall is: near edges rounding may choose either
};

/// Where a ray from inside leaves the room.
Exit leave_room(const Eigen::Vector3d& origin, const Eigen::Vector3d& ray) {
  Exit exit{1e9, 0, 0};
  double second = 1e9;
  for (int axis = 0; axis < 3; ++axis) {
    if (ray[axis] == 0.0) continue;
    const bool upward = ray[axis] > 0;
    const double t = ((upward ? kHigh : kLow)[axis] - origin[axis]) / ray[axis];
    if (t < exit.depth) {
      second = exit.depth;
      exit = {t, static_cast<std::uint32_t>(2 * axis + (upward ? 2 : 1)), 0};
    } else {
      second = std::min(second, t);
    }
  }
  exit.margin = second - exit.depth;
  return exit;
}

}  // namespace

TEST_CASE("a box room: depth to a tenth of a millimetre, ids exact away from edges, in every projection and set") {
  const scene::ScenePtr room = make_room(kLow.cast<float>(), kHigh.cast<float>());
  for (const Isa isa : {Isa::kScalar, Isa::kAvx2, Isa::kAvx512}) {
    if (isa > native_isa()) continue;
    const auto renderer = make_cpu_renderer(room, {}, isa);
    for (const Camera& camera : kCameras) {
      for (const Pose& pose : {look({0.3, 1.0, -0.4}, 0.7, 0.0), look({-1.5, 0.2, 2.0}, -2.1, 0.5)}) {
        const Picture picture = draw(*renderer, pose, camera);
        for (int y = 0; y < camera.size.height; ++y) {
          for (int x = 0; x < camera.size.width; ++x) {
            const Exit exit = leave_room(pose.translation(), pixel_ray(pose, camera, x, y));
            const std::size_t i = picture.at(y, x);
            REQUIRE(std::abs(picture.depth[i] - exit.depth) < 1e-4);
            if (exit.margin > 1e-4) REQUIRE(picture.instance[i] == exit.id);
          }
        }
      }
    }
  }
}

TEST_CASE("plain white walls show the ambient light of the side that faces the viewer") {
  const auto renderer = make_cpu_renderer(make_room(kLow.cast<float>(), kHigh.cast<float>()), {});
  const Camera camera = kCameras[0];
  const Pose pose = look({0, 1, 0}, 0.3, 0.2);
  const Picture picture = draw(*renderer, pose, camera);
  const Eigen::Vector3f normals[] = {{1, 0, 0}, {-1, 0, 0}, {0, 1, 0}, {0, -1, 0}, {0, 0, 1}, {0, 0, -1}};
  for (std::size_t i = 0; i < camera.size.pixels(); ++i) {
    const Eigen::Vector3f& n = normals[picture.instance[i] - 1];
    const auto light = std::lround(255 * render::shading::ambient_light(n.x(), n.y(), n.z()));
    for (std::size_t c = 0; c < 3; ++c) REQUIRE(picture.color[3 * i + c] == light);
  }
}
