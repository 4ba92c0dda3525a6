// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <Eigen/Core>
#include <cstdint>
#include <filesystem>
#include <span>
#include <string>
#include <vector>

namespace wiw::scene {

/// Throw FileError naming the mesh (`mesh`, "mesh 'chair'") and the first value that is not finite.
void check_positions(std::span<const Eigen::Vector3f> positions, const std::filesystem::path& path,
                     const std::string& mesh);
void check_texture_coordinates(std::span<const Eigen::Vector2f> uv, const std::filesystem::path& path,
                               const std::string& mesh);

/// Makes normals one unit long; clears all if one has no length, because the renderer's geometric normal is better than
/// a guess. Returns false then.
bool normalize_normals(std::vector<Eigen::Vector3f>& normals);

/// A channel of a colour as a display-encoded byte; `linear`: of linear light. Not-a-number becomes 0.
std::uint8_t display_byte(float value, bool linear);

}  // namespace wiw::scene
