// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <DetourNavMesh.h>

#include <cstdint>
#include <string>
#include <vector>

#include "wiw/nav/settings.hpp"

namespace wiw::nav {

/// Contents of a Habitat `.navmesh` file of one tile. Version 1 carries no settings; they are then derived from the
/// tile's header as far as it tells (agent height, radius, climb) and are the defaults otherwise.
struct NavMeshFile {
  int version = 2;
  NavMeshSettings settings;
  std::vector<std::uint8_t> tile;
};

/// Throws FileError naming file and cause if it is missing, damaged, of another version or of several tiles.
NavMeshFile read_navmesh(const std::string& path);

/// `version` 1 or 2. Throws FileError if the file cannot be written.
void write_navmesh(const std::string& path, int version, const NavMeshSettings& settings, const dtNavMesh& mesh);

}  // namespace wiw::nav
