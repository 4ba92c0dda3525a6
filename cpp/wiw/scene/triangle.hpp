// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <Eigen/Core>
#include <cstdint>

namespace wiw::scene {

/// Indices of a triangle's vertices, counter-clockwise as seen.
using Triangle = Eigen::Matrix<std::uint32_t, 3, 1>;

}  // namespace wiw::scene
