# SPDX-License-Identifier: Apache-2.0
"""Rigid bodies and robots: simulation, kinematics, grasping.

Bullet at a fixed 240 Hz; metres, kilograms, seconds, radians, and **z up**, the frame of robots. Poses are float64 [4,
4] (`T_world_body`), batches [N, 4, 4]. A world is deterministic to the last bit, whatever the threads: `World.fork` and
`World.restore` continue exactly as the original does.

Hollow things are lists of convex parts. Parts of two nearby things are compared pair by pair: two cups of 6 wall
segments each, one inside the other, run at 7000 steps per second; of 12 segments, at 2900.

    world = World()
    world.add_body(Box([1, 1, 0.1]), T_world_body=place(z=-0.05))      # a table, static
    cube = world.add_body(Box([0.04] * 3), mass=0.1, T_world_body=place(x=0.4, z=0.02))
    arm = world.add_articulation(panda())
    world.set_joint_positions(PANDA_READY)
    path = world.plan_linear(place(x=0.4, z=0.02, rpy=(np.pi, 0, 0)), PANDA_TCP)
    if path.reason == "free" and world.follow(path):
        Gripper(world).close()                                         # the index of the body it holds, or None
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from wiw._core.physics import (
    Articulation,
    Box,
    Capsule,
    Contact,
    ContactSide,
    ConvexHull,
    Cylinder,
    Gripper,
    IkResult,
    InverseKinematics,
    LinearPath,
    Sphere,
    World,
    WorldState,
    read_surface,
)

__all__ = [
    "PANDA_READY",
    "PANDA_TCP",
    "Articulation",
    "Box",
    "Capsule",
    "Contact",
    "ContactSide",
    "ConvexHull",
    "Cylinder",
    "Gripper",
    "IkResult",
    "InverseKinematics",
    "LinearPath",
    "Sphere",
    "World",
    "WorldState",
    "panda",
    "place",
    "read_surface",
]

PANDA_TCP = "panda_hand_tcp"
"""The link between the Panda's finger tips: z points out of the hand, the fingers move along y."""

PANDA_READY = np.array([0, -np.pi / 4, 0, -3 * np.pi / 4, 0, np.pi / 2, np.pi / 4, 0.04, 0.04])
"""Joint positions [9] of the Panda's usual starting pose: hand down in front of the base, fingers open."""


@cache
def panda() -> Articulation:
    """Return the Franka Panda with its hand, in simple shapes (`configs/robots/panda.urdf`): 7 joints and 2 fingers."""
    return Articulation(Path(__file__).parent / "configs" / "robots" / "panda.urdf")


def place(x: float = 0, y: float = 0, z: float = 0, rpy: Sequence[float] = (0, 0, 0)) -> NDArray[np.float64]:
    """Return the pose [4, 4] at a position in metres, turned by R = Rz(yaw) Ry(pitch) Rx(roll) in radians."""
    (cr, cp, cy), (sr, sp, sy) = np.cos(rpy), np.sin(rpy)
    pose = np.eye(4)
    pose[:3, 3] = x, y, z
    pose[:3, :3] = [
        [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr],
        [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr],
        [-sp, cp * sr, cp * cr],
    ]
    return pose
