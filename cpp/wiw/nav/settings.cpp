// SPDX-License-Identifier: Apache-2.0
#include "wiw/nav/settings.hpp"

#include <cmath>
#include <string>

#include "wiw/core/error.hpp"

namespace wiw::nav {
namespace {

void check_range(const char* name, float value, float low, float high) {
  if (std::isfinite(value) && value >= low && value <= high) return;
  throw ArgumentError(std::string("expected NavMeshSettings.") + name + " in [" + std::to_string(low) + ", " +
                      std::to_string(high) + "], got " + std::to_string(value));
}

}  // namespace

void NavMeshSettings::validate() const {
  check_range("cell_size", cell_size, 1e-3f, 10.f);
  check_range("cell_height", cell_height, 1e-3f, 10.f);
  check_range("agent_height", agent_height, 0.f, 100.f);
  check_range("agent_radius", agent_radius, 0.f, 100.f);
  check_range("agent_max_climb", agent_max_climb, 0.f, 100.f);
  check_range("agent_max_slope", agent_max_slope, 0.f, 89.f);
  check_range("region_min_size", region_min_size, 0.f, 10000.f);
  check_range("region_merge_size", region_merge_size, 0.f, 10000.f);
  check_range("edge_max_length", edge_max_length, 0.f, 10000.f);
  check_range("edge_max_error", edge_max_error, 0.f, 1000.f);
  check_range("vertices_per_polygon", vertices_per_polygon, 3.f, 6.f);
  check_range("detail_sample_distance", detail_sample_distance, 0.f, 1000.f);
  check_range("detail_sample_max_error", detail_sample_max_error, 0.f, 1000.f);
}

}  // namespace wiw::nav
