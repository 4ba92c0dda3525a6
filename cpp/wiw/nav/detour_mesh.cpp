// SPDX-License-Identifier: Apache-2.0
#include "wiw/nav/detour_mesh.hpp"

#include "wiw/core/error.hpp"
#include "wiw/nav/recast_build.hpp"

namespace wiw::nav {

DetourMesh::DetourMesh(std::vector<std::uint8_t> tile) : data_(std::move(tile)), mesh_(std::make_unique<dtNavMesh>()) {
  if (dtStatusFailed(mesh_->init(data_.data(), static_cast<int>(data_.size()), 0))) {
    throw Error("Detour refused a navigation mesh tile of " + std::to_string(data_.size()) + " bytes");
  }
  base_ = mesh_->getPolyRefBase(&this->tile());
  filter_.setIncludeFlags(kWalkable);
  filter_.setExcludeFlags(0);
  nearest_ = make_query(1);
}

std::unique_ptr<dtNavMeshQuery> DetourMesh::make_query(int max_nodes) const {
  auto query = std::make_unique<dtNavMeshQuery>();
  if (dtStatusFailed(query->init(mesh_.get(), max_nodes))) throw Error("Detour could not allocate a query");
  return query;
}

std::optional<MeshPoint> DetourMesh::project(const Eigen::Vector3f& point) const {
  static const Eigen::Vector3f half_extents(2.f, 4.f, 2.f);
  const dtMeshHeader& header = *tile().header;
  // Also keeps Detour's conversion of coordinates to integers in range; false for NaN.
  for (int axis = 0; axis < 3; ++axis) {
    const bool near =
        point[axis] >= header.bmin[axis] - half_extents[axis] && point[axis] <= header.bmax[axis] + half_extents[axis];
    if (!near) return std::nullopt;
  }
  MeshPoint result;
  const dtStatus status =
      nearest_->findNearestPoly(point.data(), half_extents.data(), &filter_, &result.ref, result.point.data());
  if (dtStatusFailed(status) || result.ref == 0) return std::nullopt;
  result.polygon = polygon_index(result.ref);
  return result;
}

DetourMesh::Lease::Lease(const DetourMesh& owner) : owner_(owner) {
  {
    const std::lock_guard lock(owner_.mutex_);
    if (!owner_.idle_.empty()) {
      query_ = std::move(owner_.idle_.back());
      owner_.idle_.pop_back();
    }
  }
  if (!query_) query_ = owner_.make_query(kMaxNodes);
}

DetourMesh::Lease::~Lease() {
  const std::lock_guard lock(owner_.mutex_);
  owner_.idle_.push_back(std::move(query_));
}

}  // namespace wiw::nav
