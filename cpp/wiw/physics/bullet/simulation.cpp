// SPDX-License-Identifier: Apache-2.0
#include "wiw/physics/bullet/simulation.hpp"

#include <cmath>

#include "wiw/core/error.hpp"
#include "wiw/physics/bullet/convert.hpp"

namespace wiw::physics {

namespace {

double checked_step(const WorldOptions& options) {
  const bool fits = options.gravity.allFinite() && options.time_step > 0 && options.time_step <= 0.1 &&
                    options.iterations > 0 && options.residual >= 0;
  if (!fits) {
    throw ArgumentError(
        "expected finite gravity, a time step in (0, 0.1] s, one solver iteration or more and a residual of 0 or more");
  }
  return options.time_step;
}

/// Bullet's own pools take 10 MB, which makes a fork take 20 ms; beyond these it allocates singly.
btDefaultCollisionConstructionInfo small_pools() {
  btDefaultCollisionConstructionInfo info;
  info.m_defaultMaxPersistentManifoldPoolSize = 256;
  info.m_defaultMaxCollisionAlgorithmPoolSize = 512;
  return info;
}

}  // namespace

Simulation::Simulation(const WorldOptions& options)
    : time_step_(checked_step(options)),
      configuration_(small_pools()),
      dispatcher_(&configuration_),
      world_(&dispatcher_, &pairs_, &solver_, &configuration_) {
  // Smooth shapes touch in one point; tilted by a hair to each side they show the patch that keeps them upright.
  configuration_.setConvexConvexMultipointIterations(4, 4);
  world_.setGravity(to_bullet(options.gravity));
  world_.setForceUpdateAllAabbs(false);
  btContactSolverInfo& solver = world_.getSolverInfo();
  solver.m_timeStep = time_step_;
  solver.m_numIterations = options.iterations;
  solver.m_leastSquaresResidualThreshold = options.residual;
  solver.m_minimumSolverBatchSize = 1;                                   // each island stops when it is solved
  solver.m_solverMode = SOLVER_SIMD | SOLVER_USE_2_FRICTION_DIRECTIONS;  // no warm start: contacts are always new
  solver.m_linearSlop = 1e-5;
}

}  // namespace wiw::physics
