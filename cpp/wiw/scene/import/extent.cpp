// SPDX-License-Identifier: Apache-2.0
#include "wiw/scene/import/extent.hpp"

#include "wiw/core/error.hpp"

namespace wiw::scene {
namespace {

constexpr float kMost = 1e7f;

bool is_near(const Scene& scene, const Instance& instance) {
  for (const std::uint32_t mesh : instance.meshes) {
    for (const Eigen::Vector3f& position : scene.meshes[mesh].positions) {
      const Eigen::Vector3f p = instance.T_world_instance * position;
      if (!(p.array().abs() <= kMost).all()) return false;  // NaN is not near either
    }
  }
  return true;
}

}  // namespace

void check_imported(const Scene& scene, const std::filesystem::path& path) {
  try {
    scene.validate();
  } catch (const ArgumentError& error) {
    throw FileError(path.string(), std::string(error.what()) + " (damaged file, or numbers that overflow)");
  }
  for (const Instance& instance : scene.instances) {
    if (is_near(scene, instance)) continue;
    throw FileError(path.string(),
                    "'" + instance.name +
                        "' reaches farther than 10^7 units from the origin (damaged file, or numbers that overflow)");
  }
}

}  // namespace wiw::scene
