// SPDX-License-Identifier: Apache-2.0
#include "wiw/physics/bullet/pair_finder.hpp"

#include <LinearMath/btAabbUtil2.h>

#include <algorithm>

namespace wiw::physics {

btBroadphaseProxy* PairFinder::createProxy(const btVector3& low, const btVector3& high, int, void* object, int group,
                                           int mask, btDispatcher*) {
  proxies_.push_back(std::make_unique<btBroadphaseProxy>(low, high, object, group, mask));
  proxies_.back()->m_uniqueId = next_id_++;
  return proxies_.back().get();
}

void PairFinder::destroyProxy(btBroadphaseProxy* proxy, btDispatcher* dispatcher) {
  pairs_.removeOverlappingPairsContainingProxy(proxy, dispatcher);
  std::erase_if(proxies_, [proxy](const auto& each) { return each.get() == proxy; });
}

void PairFinder::setAabb(btBroadphaseProxy* proxy, const btVector3& low, const btVector3& high, btDispatcher*) {
  proxy->m_aabbMin = low;
  proxy->m_aabbMax = high;
}

void PairFinder::getAabb(btBroadphaseProxy* proxy, btVector3& low, btVector3& high) const {
  low = proxy->m_aabbMin;
  high = proxy->m_aabbMax;
}

void PairFinder::rayTest(const btVector3&, const btVector3&, btBroadphaseRayCallback& callback, const btVector3&,
                         const btVector3&) {
  for (const auto& proxy : proxies_) callback.process(proxy.get());
}

void PairFinder::aabbTest(const btVector3& low, const btVector3& high, btBroadphaseAabbCallback& callback) {
  for (const auto& proxy : proxies_) {
    if (TestAabbAgainstAabb2(low, high, proxy->m_aabbMin, proxy->m_aabbMax)) callback.process(proxy.get());
  }
}

void PairFinder::calculateOverlappingPairs(btDispatcher* dispatcher) {
  for (int i = pairs_.getNumOverlappingPairs() - 1; i >= 0; --i) {
    const btBroadphasePair& pair = pairs_.getOverlappingPairArray()[i];
    pairs_.removeOverlappingPair(pair.m_pProxy0, pair.m_pProxy1, dispatcher);
  }
  for (std::size_t i = 0; i < proxies_.size(); ++i) {
    btBroadphaseProxy& a = *proxies_[i];
    for (std::size_t j = i + 1; j < proxies_.size(); ++j) {
      btBroadphaseProxy& b = *proxies_[j];
      if (TestAabbAgainstAabb2(a.m_aabbMin, a.m_aabbMax, b.m_aabbMin, b.m_aabbMax)) pairs_.addOverlappingPair(&a, &b);
    }
  }
}

void PairFinder::getBroadphaseAabb(btVector3& low, btVector3& high) const {
  low.setValue(BT_LARGE_FLOAT, BT_LARGE_FLOAT, BT_LARGE_FLOAT);
  high = -low;
  for (const auto& proxy : proxies_) {
    low.setMin(proxy->m_aabbMin);
    high.setMax(proxy->m_aabbMax);
  }
}

}  // namespace wiw::physics
