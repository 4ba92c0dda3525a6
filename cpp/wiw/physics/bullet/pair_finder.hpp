// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <BulletCollision/BroadphaseCollision/btBroadphaseInterface.h>
#include <BulletCollision/BroadphaseCollision/btBroadphaseProxy.h>
#include <BulletCollision/BroadphaseCollision/btOverlappingPairCache.h>

#include <memory>
#include <vector>

namespace wiw::physics {

/// Broadphase without memory: at each detection the pairs are found afresh, in the order in which things were added.
/// Contact caches die with their pairs, so that a step is a function of positions, velocities and commands alone, which
/// is what makes snapshots and forks exact. Tests all pairs of boxes; scenes here hold tens of things.
class PairFinder final : public btBroadphaseInterface {
 public:
  btBroadphaseProxy* createProxy(const btVector3& low, const btVector3& high, int shape, void* object, int group,
                                 int mask, btDispatcher* dispatcher) override;
  void destroyProxy(btBroadphaseProxy* proxy, btDispatcher* dispatcher) override;
  void setAabb(btBroadphaseProxy* proxy, const btVector3& low, const btVector3& high, btDispatcher*) override;
  void getAabb(btBroadphaseProxy* proxy, btVector3& low, btVector3& high) const override;
  void rayTest(const btVector3& from, const btVector3& to, btBroadphaseRayCallback& callback, const btVector3& low,
               const btVector3& high) override;
  void aabbTest(const btVector3& low, const btVector3& high, btBroadphaseAabbCallback& callback) override;
  void calculateOverlappingPairs(btDispatcher* dispatcher) override;
  btOverlappingPairCache* getOverlappingPairCache() override { return &pairs_; }
  [[nodiscard]] const btOverlappingPairCache* getOverlappingPairCache() const override { return &pairs_; }
  void getBroadphaseAabb(btVector3& low, btVector3& high) const override;
  void printStats() override {}

 private:
  std::vector<std::unique_ptr<btBroadphaseProxy>> proxies_;
  btHashedOverlappingPairCache pairs_;
  int next_id_ = 1;
};

}  // namespace wiw::physics
