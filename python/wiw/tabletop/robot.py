# SPDX-License-Identifier: Apache-2.0
"""The arm at the table: the project's own Panda, or one described by a URDF file.

Whatever a description leaves open is inferred: two links that slide on the same link are the fingers, and that link is
the hand; the point between the finger tips is the link whose name says so (`TOOL_WORDS`).
"""

from __future__ import annotations

import hashlib
import re
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cache, cached_property
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from wiw.errors import ArgumentError
from wiw.physics import PANDA_READY, PANDA_TCP, Articulation, Gripper, InverseKinematics, World, panda
from wiw.tabletop.description import read_description
from wiw.tabletop.link_meshes import LinkMeshes, build_link_meshes

TOOL_WORDS = ("tcp", "grasptarget", "grasp_target", "tool", "tip", "ee")
"""Words in the name of the link between the finger tips, the most specific first."""


@dataclass(frozen=True)
class Robot:
    """An arm with two fingers.

    The frame of `tcp` lies between the finger tips: z points out of the hand, the fingers move along y.
    """

    description: Articulation
    tcp: str
    hand: str
    fingers: tuple[str, str]
    finger_joints: tuple[str, str]
    identity: dict[str, Any] = field(default_factory=dict)
    """JSON-able: equal for equal robots."""
    file_meshes: LinkMeshes | None = field(default=None, compare=False, repr=False)
    """Link meshes of a robot whose files were read in a separate process."""

    @cached_property
    def link_meshes(self) -> LinkMeshes:
        """(link, mesh in the link's frame) of every visible link."""
        return build_link_meshes(self.description) if self.file_meshes is None else self.file_meshes

    @cached_property
    def tool_index(self) -> int:
        """Index of the link between the finger tips."""
        return self.description.link_index(self.tcp)

    def create_gripper(self, world: World, arm: int) -> Gripper:
        """Create the gripper of this robot's instance `arm` in a world."""
        return Gripper(world, arm, joints=self.finger_joints, fingers=self.fingers, hand=self.hand)

    @cached_property
    def ready_joints(self) -> NDArray[np.float64]:
        """Joint positions float64 [dof] with the hand pointing down in front of the base, as in the Panda's usual
        start pose, fingers open.

        Raises:
            ArgumentError: the arm cannot reach that pose.
        """
        limits = self.description.limits
        if self.description.joints == panda().joints:
            start = np.clip(PANDA_READY, limits["lower"], limits["upper"])
            if np.array_equal(start[:-2], PANDA_READY[:-2]):  # fingers may open less
                return start
        start = np.clip(0, np.maximum(limits["lower"], -np.pi), np.minimum(limits["upper"], np.pi))
        for joint in self.finger_joints:
            index = self.description.joint_index(joint)
            start[index] = limits["upper"][index]
        wanted = panda().forward_kinematics(PANDA_READY)[panda().link_index(PANDA_TCP)]
        found = InverseKinematics(self.description, self.tcp)(wanted, start, restarts=1000)
        if not found.reached:
            x, y, z = wanted[:3, 3]
            raise ArgumentError(
                f"robot {self.description.name}: expected an arm whose '{self.tcp}' reaches ({x:.2f}, {y:.2f}, "
                f"{z:.2f}) m before its base with the hand down, where work begins; {found.reason}"
            )
        return found.joints


@cache
def load_panda() -> Robot:
    """Return the Franka Panda, which the project describes by simple shapes."""
    return _build_robot(panda(), PANDA_TCP, {"name": "panda"})


def load_robot(file: str | PathLike[str], tcp: str = "") -> Robot:
    """Load the robot that a URDF file describes.

    Args:
        file: its description; meshes are found beside it, `package://NAME/...` in the folders above it.
        tcp: the link between the finger tips: z points out of the hand, the fingers move along y. Found by name if "".

    Raises:
        FileError: the file or a mesh is missing or damaged; the message names the link.
        ArgumentError: it has no two fingers, or no such link, or another frame there; the message says what was
            expected and what was found.
    """
    path = Path(file).expanduser().absolute()
    cached = _CACHE.get((path, tcp))
    if cached is not None and cached.digest == _compute_digest(path, cached.meshes):
        return cached.robot
    description = read_description(path)
    meshes = tuple(map(Path, description.articulation.meshes))
    digest = _compute_digest(path, meshes)
    identity = {"name": path.name, "digest": digest, **({"tcp": tcp} if tcp else {})}
    robot = _build_robot(description.articulation, tcp, identity, description.link_meshes)
    _ = robot.ready_joints  # an arm that does not come there is refused here
    _CACHE[path, tcp] = _CachedRobot(digest, meshes, robot)
    return robot


@dataclass(frozen=True)
class _CachedRobot:
    """A robot, and the files it was read from."""

    digest: str
    meshes: tuple[Path, ...]
    robot: Robot


_CACHE: dict[tuple[Path, str], _CachedRobot] = {}
"""Loaded robots by file and tool link."""


def _compute_digest(path: Path, meshes: Sequence[Path]) -> str:
    """Return the digest of a description and its meshes."""
    state = hashlib.sha256(path.read_bytes() if path.is_file() else b"")
    for mesh in meshes:
        state.update(mesh.read_bytes() if mesh.is_file() else b"")
    return state.hexdigest()[:16]


def _build_robot(
    description: Articulation, tcp: str, identity: dict[str, Any], link_meshes: LinkMeshes | None = None
) -> Robot:
    left, right = _find_finger_joints(description)
    hand = left["parent"]
    robot = Robot(
        description,
        tcp or _find_tool_link(description, hand),
        hand,
        (left["child"], right["child"]),
        (left["name"], right["name"]),
        identity,
        link_meshes,
    )
    _check_frame(robot)
    return robot


def _find_finger_joints(description: Articulation) -> list[dict[str, str]]:
    """Return the two joints whose links slide on the same link."""
    sliding: dict[str, list[dict[str, str]]] = {}
    for joint in description.tree:
        if joint["type"] == "prismatic":
            sliding.setdefault(joint["parent"], []).append(joint)
    pairs = [joints for joints in sliding.values() if len(joints) == 2]
    if len(pairs) == 1:
        return pairs[0]
    raise ArgumentError(
        f"robot {description.name}: expected one link, the hand, on which two fingers slide (prismatic joints), found "
        f"{len(pairs)}; the joints that move are {', '.join(description.joints)}"
    )


def _find_tool_link(description: Articulation, hand: str) -> str:
    """Return the link between the finger tips: fixed to the hand, directly or not, and named accordingly."""
    fixed = [hand]
    for joint in description.tree:  # parents come first
        if joint["type"] == "fixed" and joint["parent"] in fixed:
            fixed.append(joint["child"])
    for word in TOOL_WORDS:
        for name in fixed[1:]:
            if word in name.lower() if "_" in word else word in re.split(r"[^a-z0-9]+", name.lower()):
                return name
    raise ArgumentError(
        f"robot {description.name}: expected a link between the finger tips, fixed to '{hand}' and with one of the "
        f"words {', '.join(TOOL_WORDS)} in its name; choose another with robot_tcp=LINK, from "
        f"{', '.join(description.links)}"
    )


def _check_frame(robot: Robot) -> None:
    """Check that the frame between the finger tips is oriented as gripper poses are."""
    description, ends = robot.description, []
    for end in ("lower", "upper"):
        limits = description.limits
        positions = np.clip(0, limits["lower"], limits["upper"])
        for joint in robot.finger_joints:
            positions[description.joint_index(joint)] = limits[end][description.joint_index(joint)]
        ends.append(description.forward_kinematics(positions))
    hand = description.link_index(robot.hand)
    closed, opened = (np.linalg.solve(end[hand], end[robot.tool_index]) for end in ends)
    if not np.allclose(closed, opened):
        raise ArgumentError(
            f"robot {description.name}: expected '{robot.tcp}' to be fixed to the hand, '{robot.hand}', but it moves "
            "with a finger; choose another with robot_tcp=LINK"
        )
    tip = np.linalg.inv(ends[0][robot.tool_index])
    way = tip[:3, :3] @ (ends[1] - ends[0])[description.link_index(robot.fingers[0]), :3, 3]
    behind = (tip @ ends[0][hand])[2, 3]
    if abs(way[1]) < 0.99 * np.linalg.norm(way) or not np.linalg.norm(way) or behind >= 0:
        raise ArgumentError(
            f"robot {description.name}: expected '{robot.tcp}' as a frame between the finger tips with z out of the "
            f"hand and the fingers moving along y; they move along {np.round(way, 3).tolist()} m, the hand's frame "
            f"lies {behind:+.3f} m along z; choose another with robot_tcp=LINK"
        )
