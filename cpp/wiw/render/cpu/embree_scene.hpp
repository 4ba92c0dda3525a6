// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <embree3/rtcore.h>

#include <memory>
#include <span>
#include <string>
#include <type_traits>
#include <vector>

#include "wiw/core/cpu.hpp"
#include "wiw/render/cpu/shading_scene.hpp"

namespace wiw::render::cpu {

struct EmbreeRelease {
  void operator()(RTCDevice device) const { rtcReleaseDevice(device); }
  void operator()(RTCScene scene) const { rtcReleaseScene(scene); }
  void operator()(RTCGeometry geometry) const { rtcReleaseGeometry(geometry); }
};
/// Owns a device, scene or geometry of Embree.
template <class Handle>
using EmbreeOwner = std::unique_ptr<std::remove_pointer_t<Handle>, EmbreeRelease>;

/// The parts' triangles in two Embree scenes: one built once from everything, and a small dynamic one with the parts
/// that have been moved. Each part is masked out of one of them: out of the first while it is away from where the scene
/// has it, so that one is never rebuilt. Geometry ids are part numbers in both.
class EmbreeScene {
 public:
  EmbreeScene(const scene::Scene& scene, const ShadingScene& shading, Isa isa);
  EmbreeScene(const EmbreeScene&) = delete;
  EmbreeScene& operator=(const EmbreeScene&) = delete;

  struct MeshPlacement {
    std::size_t number;  // of the part
    const Eigen::Affine3f* T_world_instance;
  };
  void move(std::span<const MeshPlacement> parts);

  [[nodiscard]] RTCScene fixed() const { return fixed_.get(); }
  /// Null while every part is where the scene has it.
  [[nodiscard]] RTCScene moved() const { return away_count_ > 0 ? moved_.get() : nullptr; }
  [[nodiscard]] std::string version() const;

 private:
  struct Cutout {
    const TriangleRecord* records;
    const ShadingSurface* surface;
  };
  static void pierce(const RTCFilterFunctionNArguments* arguments);

  void adopt(std::size_t part);
  void show(std::size_t part, bool from_fixed);
  [[nodiscard]] bool is_home(const MeshPlacement& part) const;
  EmbreeOwner<RTCGeometry> make_geometry(std::size_t part, const Eigen::Affine3f& T_world_instance);
  void set_triangles(RTCGeometry geometry, std::size_t part) const;
  void write_vertices(RTCGeometry geometry, std::size_t part, const Eigen::Affine3f& T_world_instance) const;
  void check(const char* what) const;

  const scene::Scene& scene_;
  const ShadingScene& shading_;
  std::vector<Cutout> cutouts_;  // by part
  EmbreeOwner<RTCDevice> device_;
  EmbreeOwner<RTCScene> fixed_;
  EmbreeOwner<RTCScene> moved_;
  std::vector<bool> in_moved_;  // by part
  std::vector<bool> away_;      // by part
  int away_count_ = 0;
};

}  // namespace wiw::render::cpu
