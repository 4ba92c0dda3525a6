// SPDX-License-Identifier: Apache-2.0
#include "wiw/scene/apartment/apartment.hpp"

#include <algorithm>
#include <array>

#include "wiw/core/error.hpp"
#include "wiw/scene/apartment/draft.hpp"

namespace wiw {

namespace {

constexpr std::array<const char*, 3> kSplitNames{"train", "val", "test"};

}  // namespace

Split split_from_name(const std::string& name) {
  for (std::size_t i = 0; i < kSplitNames.size(); ++i) {
    if (name == kSplitNames[i]) return static_cast<Split>(i);
  }
  throw ArgumentError("split must be 'train', 'val' or 'test', got '" + name + "'");
}

std::string split_name(Split split) { return kSplitNames[static_cast<std::size_t>(split)]; }

Scene apartment(std::uint64_t seed, Split split, ThreadPool& pool) {
  interior::Draft draft;
  draft.seed = seed;
  draft.split = split;
  draft.plan = interior::make_floor_plan(seed, split);
  draft.palette = interior::make_palette(seed, split, draft.plan);
  draft.materials = interior::MaterialTable(seed);
  interior::build_walls(draft);
  interior::build_openings(draft);
  interior::furnish(draft);
  return interior::bake(draft, pool);
}

ApartmentIdentity apartment_identity(std::uint64_t seed, Split split) {
  const interior::FloorPlan plan = interior::make_layout(seed, split);
  ApartmentIdentity identity{plan.signature, {}};
  for (const auto& color : interior::make_palette(seed, split, plan).colors())
    identity.palette.push_back(interior::hex_code(color));
  std::sort(identity.palette.begin(), identity.palette.end());
  return identity;
}

}  // namespace wiw
