// SPDX-License-Identifier: Apache-2.0
#pragma once

namespace wiw::nav {

/// How walkable surfaces become polygons. Defaults are Habitat's (NavMeshSettings::setDefaults), so that meshes built
/// here agree with the ones its users know. Lengths in metres, angles in degrees, as those files store them.
struct NavMeshSettings {
  float cell_size = 0.05f;
  float cell_height = 0.2f;
  float agent_height = 1.5f;
  float agent_radius = 0.1f;
  float agent_max_climb = 0.2f;
  float agent_max_slope = 45.f;
  float region_min_size = 20.f;    // cells along a side of the smallest region kept
  float region_merge_size = 20.f;  // cells along a side of the largest region merged into its neighbour
  float edge_max_length = 12.f;
  float edge_max_error = 1.3f;  // cells
  float vertices_per_polygon = 6.f;
  float detail_sample_distance = 6.f;   // cells; below 0.9 the detail mesh has no inner samples
  float detail_sample_max_error = 1.f;  // cell heights
  bool filter_low_hanging_obstacles = true;
  bool filter_ledge_spans = true;
  bool filter_walkable_low_height_spans = true;
  bool include_static_objects = false;  // kept for the file format only; a Scene has no such distinction

  bool operator==(const NavMeshSettings&) const = default;
  /// Throws ArgumentError naming the first value out of range.
  void validate() const;
};

}  // namespace wiw::nav
