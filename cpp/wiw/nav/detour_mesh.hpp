// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <DetourNavMesh.h>
#include <DetourNavMeshQuery.h>

#include <Eigen/Core>
#include <cstdint>
#include <memory>
#include <mutex>
#include <optional>
#include <utility>
#include <vector>

namespace wiw::nav {

/// Where a point meets the mesh.
struct MeshPoint {
  dtPolyRef ref = 0;
  int polygon = -1;
  Eigen::Vector3f point;
};

/// One Detour tile and the objects that query it. Const methods may be called from any thread: those that need
/// scratch memory borrow a query object of their own.
class DetourMesh {
 public:
  /// Takes a checked tile (see tile_check.hpp).
  explicit DetourMesh(std::vector<std::uint8_t> tile);

  [[nodiscard]] const dtNavMesh& mesh() const { return *mesh_; }
  [[nodiscard]] const dtMeshTile& tile() const { return *std::as_const(*mesh_).getTile(0); }
  [[nodiscard]] const dtQueryFilter& filter() const { return filter_; }
  [[nodiscard]] const std::vector<std::uint8_t>& data() const { return data_; }
  [[nodiscard]] int polygon_index(dtPolyRef ref) const { return static_cast<int>(mesh_->decodePolyIdPoly(ref)); }
  [[nodiscard]] dtPolyRef polygon_ref(int polygon) const { return base_ | static_cast<dtPolyRef>(polygon); }

  void set_flags(int polygon, unsigned short flags) { mesh_->setPolyFlags(polygon_ref(polygon), flags); }

  /// Nearest point of the mesh within 2 m sideways and 4 m up or down; empty if there is none.
  [[nodiscard]] std::optional<MeshPoint> project(const Eigen::Vector3f& point) const;

  /// A query object for one caller at a time; goes back when the lease ends.
  class Lease {
   public:
    explicit Lease(const DetourMesh& owner);
    ~Lease();
    Lease(const Lease&) = delete;
    Lease& operator=(const Lease&) = delete;
    const dtNavMeshQuery* operator->() const { return query_.get(); }
    const dtNavMeshQuery& operator*() const { return *query_; }

   private:
    const DetourMesh& owner_;
    std::unique_ptr<dtNavMeshQuery> query_;
  };

  static constexpr int kMaxNodes = 2048;  // Habitat's node pool
  [[nodiscard]] std::unique_ptr<dtNavMeshQuery> make_query(int max_nodes) const;

 private:
  std::vector<std::uint8_t> data_;  // Detour keeps pointers into it
  std::unique_ptr<dtNavMesh> mesh_;
  dtPolyRef base_ = 0;
  dtQueryFilter filter_;
  std::unique_ptr<dtNavMeshQuery> nearest_;  // nearest-polygon search uses no scratch memory, so all threads share it
  mutable std::mutex mutex_;
  mutable std::vector<std::unique_ptr<dtNavMeshQuery>> idle_;
};

}  // namespace wiw::nav
