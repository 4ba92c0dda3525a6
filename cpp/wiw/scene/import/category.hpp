// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <string>
#include <string_view>
#include <vector>

#include "wiw/scene/scene.hpp"

namespace wiw::scene {

/// The category that a model, node or material name speaks of, or "" if it says nothing:
///  1. the publisher's prefix `aws_robomaker_<kind>_` is dropped;
///  2. the name is cut into words at everything that is not a letter and where the case says so (TVCabinet -> TV,
///     Cabinet; ChairA -> Chair, A);
///  3. single letters (variants) and words that name no thing (mesh, node, visual, material, ...) are dropped, and
///     `room` or `house` in front of another word;
///  4. the rest is joined in lower case: `aws_robomaker_residential_ChairA_01` -> "chair", `TVCabinet_01` ->
///     "tv cabinet", `nodes[3]` -> "".
std::string category_from_name(std::string_view name);

/// Index of `category` in Scene::categories, added if new; kNone for "".
std::int32_t category_index(Scene& scene, const std::string& category);

}  // namespace wiw::scene
