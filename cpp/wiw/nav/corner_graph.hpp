// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstdint>
#include <span>
#include <vector>

#include "wiw/nav/sight.hpp"

namespace wiw::nav {

/// A corner and the metres to it.
struct CornerDistance {
  std::int32_t corner = -1;
  double metres = 0;
};

/// The visibility graph of the corners: an edge where two see each other and a shortest path can bend at both ends.
class CornerGraph {
 public:
  CornerGraph(const PolygonGraph& graph, const Corners& corners);

  [[nodiscard]] std::size_t size() const { return offsets_.size() - 1; }
  [[nodiscard]] std::span<const CornerDistance> edges(std::size_t corner) const {
    return {legs_.data() + offsets_[corner], legs_.data() + offsets_[corner + 1]};
  }

  /// Metres from the nearest seed to every corner (infinite where there is no path); `parents`, if given, receives the
  /// corner before each, -1 at seeds. Dijkstra.
  void find_distances(std::span<const CornerDistance> seeds, std::span<double> metres,
                      std::vector<std::int32_t>* parents = nullptr) const;

 private:
  std::vector<std::size_t> offsets_;
  std::vector<CornerDistance> legs_;
};

}  // namespace wiw::nav
