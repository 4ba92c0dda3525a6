// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstdint>
#include <string>
#include <vector>

#include "wiw/core/thread_pool.hpp"
#include "wiw/scene/scene.hpp"

namespace wiw::apartment {

/// Which part of an experiment a generated scene belongs to. Splits share neither floor plans nor palettes.
enum class Split { kTrain = 0, kVal = 1, kTest = 2 };

/// "train", "val" or "test"; anything else throws ArgumentError.
Split split_from_name(const std::string& name);
std::string split_name(Split split);

struct Edit;

/// Furnished apartment of 5 to 9 rooms with baked light: floor at y = 0, rooms side by side in the xz plane.
/// A function of (seed, split) alone, to the byte; every room can be reached by an agent of radius 0.3 m.
/// Scene::attributes: "split", "seed", "layout" (signature of the plan), "area_m2".
scene::Scene make_apartment(std::uint64_t seed, Split split, ThreadPool& pool = ThreadPool::shared());

/// The same with edits (see Edit); without any, the same bytes. Scene::attributes: also "edits", joined by "&".
scene::Scene make_apartment(std::uint64_t seed, Split split, const std::vector<Edit>& edits,
                            ThreadPool& pool = ThreadPool::shared());
/// The same rooms and instances without textures and light, in a fraction of the time.
scene::Scene outline_apartment(std::uint64_t seed, Split split, const std::vector<Edit>& edits);
/// Edits that the apartment with `edits` can have as well.
std::vector<Edit> possible_edits(std::uint64_t seed, Split split, const std::vector<Edit>& edits);

/// What splits keep apart, computed without furnishing or baking.
struct ApartmentIdentity {
  std::string layout;                // kind of plan and order of its rooms, equal for mirror images
  std::vector<std::string> palette;  // colours of walls, floors, wood and fabrics, as "#rrggbb", sorted
};
ApartmentIdentity apartment_identity(std::uint64_t seed, Split split);

}  // namespace wiw::apartment
