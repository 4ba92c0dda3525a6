# SPDX-License-Identifier: Apache-2.0
"""Navigation meshes: where an agent can stand, and how far it is from one place to another.

Points are float [N, 3] (or [3]) in metres, Y up; every query takes a whole batch and releases the GIL. Meshes are built
with Recast at Habitat's default settings and travel as Habitat's `.navmesh` files.

There are three metrics of length. `"exact"`, the default, is the length of the shortest way over the mesh measured
horizontally; it has no limit on the way's length, is symmetric and obeys the triangle inequality. On level floors that
is the walked length; on stairs and ramps the climb is not counted, and the way is the one that is shortest seen from
above. `"detour"` reproduces Habitat's answers: the 3D length of a taut string through the first polygon corridor that
A* finds, often a little too long, not symmetric, and infinite beyond 256 polygons. `"detour-uncapped"` is the same
search without that limit.
"""

from wiw._core.nav import DistanceField, Ground, Island, NavMesh, NavMeshSettings, select_waypoints

__all__ = ["DistanceField", "Ground", "Island", "NavMesh", "NavMeshSettings", "select_waypoints"]
