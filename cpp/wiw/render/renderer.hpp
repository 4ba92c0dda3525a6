// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstdint>
#include <memory>
#include <span>
#include <string>

#include "wiw/core/intrinsics.hpp"
#include "wiw/core/pose.hpp"
#include "wiw/scene/scene.hpp"

namespace wiw::render {

enum class Projection {
  kPerspective,      // depth is planar z
  kEquirectangular,  // rows cover 180 degrees, columns 360, front at the centre; depth is the distance along the ray
};

struct Camera {
  Projection projection = Projection::kPerspective;
  Size size;
  double hfov = kPi / 2;  // radians, perspective only
};

/// Where a batch of views is written; null members are not computed. All arrays are dense, batch-major.
struct RenderTargets {
  std::uint8_t* color = nullptr;      // [B, H, W, 3]
  float* depth = nullptr;             // [B, H, W] metres, 0 where nothing is hit
  std::uint32_t* instance = nullptr;  // [B, H, W] Instance::id, 0 where nothing is hit
};

struct RenderOptions {
  int samples = 1;  // colour samples per pixel (1, 4, 9, 16); depth and ids always come from the pixel centre's ray
};

/// Draws one scene. Both sides of every triangle are visible. Calls from several threads are serialised inside.
class Renderer {
 public:
  virtual ~Renderer() = default;
  virtual void render(std::span<const Pose> T_world_camera, const Camera& camera, const RenderTargets& targets) = 0;

  /// Moves instances; the rest stay. Throws ArgumentError for an unknown id. `poses[i]` replaces T_world_instance.
  virtual void set_poses(std::span<const std::uint32_t> ids, std::span<const Eigen::Affine3f> poses) = 0;

  [[nodiscard]] virtual const scene::Scene& scene() const = 0;
  /// "cpu (Embree 3.13.5, avx512)", "gpu (llvmpipe ..., OpenGL 4.5)".
  [[nodiscard]] virtual std::string description() const = 0;
};

enum class Backend { kAuto, kCpu, kGpu };

/// kAuto takes the GPU when a hardware EGL device exists, else the CPU ray caster (a software EGL device is slower).
/// Throws BackendError with the remedy when the asked back end cannot run here.
std::shared_ptr<Renderer> make_renderer(scene::ScenePtr scene, Backend backend, const RenderOptions& options = {});

}  // namespace wiw::render
