// SPDX-License-Identifier: Apache-2.0
#include "wiw/nav/corner_graph.hpp"

#include <algorithm>
#include <limits>
#include <utility>

#include "wiw/core/thread_pool.hpp"

namespace wiw::nav {
namespace {

/// Corners seen from each corner, in blocks so that threads share the work without sharing memory.
std::vector<std::vector<std::int32_t>> see_all(const PolygonGraph& graph, const Corners& corners) {
  constexpr std::size_t kBlock = 32;
  const std::size_t count = corners.list.size();
  std::vector<std::vector<std::int32_t>> seen(count);
  parallel_for((count + kBlock - 1) / kBlock, [&](std::size_t block) {
    Sight sight(graph, corners);
    for (std::size_t i = block * kBlock; i < std::min(count, (block + 1) * kBlock); ++i) {
      const Corner& self = corners.list[i];
      sight.from_corner(static_cast<int>(i), [&](int other) {
        if (self.is_taut(corners.list[other].at)) seen[i].push_back(other);
      });
    }
  });
  return seen;
}

}  // namespace

CornerGraph::CornerGraph(const PolygonGraph& graph, const Corners& corners) {
  std::vector<std::pair<std::int32_t, std::int32_t>> edges;
  const auto seen = see_all(graph, corners);
  for (std::size_t i = 0; i < seen.size(); ++i) {
    for (const std::int32_t other : seen[i]) {
      edges.emplace_back(static_cast<std::int32_t>(i), other);
      edges.emplace_back(other, static_cast<std::int32_t>(i));
    }
  }
  std::sort(edges.begin(), edges.end());
  edges.erase(std::unique(edges.begin(), edges.end()), edges.end());
  offsets_.assign(seen.size() + 1, 0);
  for (const auto& [from, to] : edges) {
    ++offsets_[from + 1];
    legs_.push_back({to, graph.scale() * length(corners.list[to].at - corners.list[from].at)});
  }
  for (std::size_t i = 1; i < offsets_.size(); ++i) offsets_[i] += offsets_[i - 1];
}

void CornerGraph::find_distances(std::span<const CornerDistance> seeds, std::span<double> metres,
                                 std::vector<std::int32_t>* parents) const {
  const auto farther = [](const CornerDistance& a, const CornerDistance& b) { return a.metres > b.metres; };
  std::fill(metres.begin(), metres.end(), std::numeric_limits<double>::infinity());
  if (parents) parents->assign(size(), -1);
  std::vector<CornerDistance> heap;
  const auto offer = [&](const CornerDistance& leg, std::int32_t from) {
    if (leg.metres >= metres[leg.corner]) return;
    metres[leg.corner] = leg.metres;
    if (parents) (*parents)[leg.corner] = from;
    heap.push_back(leg);
    std::push_heap(heap.begin(), heap.end(), farther);
  };
  for (const CornerDistance& seed : seeds) offer(seed, -1);
  while (!heap.empty()) {
    std::pop_heap(heap.begin(), heap.end(), farther);
    const CornerDistance nearest = heap.back();
    heap.pop_back();
    if (nearest.metres > metres[nearest.corner]) continue;
    for (const CornerDistance& edge : edges(nearest.corner))
      offer({edge.corner, nearest.metres + edge.metres}, nearest.corner);
  }
}

}  // namespace wiw::nav
