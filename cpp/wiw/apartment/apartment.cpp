// SPDX-License-Identifier: Apache-2.0
#include "wiw/apartment/apartment.hpp"

#include <algorithm>
#include <array>

#include "wiw/apartment/draft.hpp"
#include "wiw/apartment/edits.hpp"
#include "wiw/core/error.hpp"

namespace wiw::apartment {

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

Draft make_draft(std::uint64_t seed, Split split, const std::vector<Edit>& edits) {
  Draft draft;
  draft.seed = seed;
  draft.split = split;
  draft.plan = make_floor_plan(seed, split);
  draft.palette = make_palette(seed, split, draft.plan);
  draft.materials = MaterialTable(seed);
  build_walls(draft);
  build_openings(draft);
  furnish(draft);
  balance_lights(draft);
  apply_edits(draft, edits);
  return draft;
}

scene::Scene make_apartment(std::uint64_t seed, Split split, ThreadPool& pool) {
  return make_apartment(seed, split, {}, pool);
}

scene::Scene make_apartment(std::uint64_t seed, Split split, const std::vector<Edit>& edits, ThreadPool& pool) {
  return bake(make_draft(seed, split, edits), pool);
}

scene::Scene outline_apartment(std::uint64_t seed, Split split, const std::vector<Edit>& edits) {
  return outline(make_draft(seed, split, edits));
}

std::vector<Edit> possible_edits(std::uint64_t seed, Split split, const std::vector<Edit>& edits) {
  return possible_edits(make_draft(seed, split, edits), edits);
}

ApartmentIdentity apartment_identity(std::uint64_t seed, Split split) {
  const FloorPlan plan = make_layout(seed, split);
  ApartmentIdentity identity{plan.signature, {}};
  for (const auto& color : make_palette(seed, split, plan).colors()) identity.palette.push_back(hex_code(color));
  std::sort(identity.palette.begin(), identity.palette.end());
  return identity;
}

}  // namespace wiw::apartment
