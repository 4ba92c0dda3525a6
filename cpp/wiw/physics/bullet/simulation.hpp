// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <BulletCollision/CollisionDispatch/btDefaultCollisionConfiguration.h>
#include <BulletDynamics/Featherstone/btMultiBodyConstraintSolver.h>
#include <BulletDynamics/Featherstone/btMultiBodyDynamicsWorld.h>

#include "wiw/physics/bullet/pair_finder.hpp"
#include "wiw/physics/world.hpp"

namespace wiw::physics {

/// Bullet's world and what it needs, set up so that a step depends on nothing but the state.
class Simulation {
 public:
  explicit Simulation(const WorldOptions& options);
  [[nodiscard]] btMultiBodyDynamicsWorld& world() { return world_; }
  void step() { world_.stepSimulation(time_step_, 0); }

 private:
  const double time_step_;
  btDefaultCollisionConfiguration configuration_;
  btCollisionDispatcher dispatcher_;
  PairFinder pairs_;
  btMultiBodyConstraintSolver solver_;
  btMultiBodyDynamicsWorld world_;
};

}  // namespace wiw::physics
