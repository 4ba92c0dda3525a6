# SPDX-License-Identifier: Apache-2.0
"""The arm that works at the table: the project's own Panda, or one that is described by a URDF file.

What a description does not say is found in it: two links that slide on the same one are the fingers, and that one is
the hand; the point between the finger tips is the link whose name says so (`TOOLS`).
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
from wiw.tabletop.looks import Looks, looks_of

TOOLS = ("tcp", "grasptarget", "grasp_target", "tool", "tip", "ee")
"""Words in the name of the link between the finger tips, the most telling first."""


@dataclass(frozen=True)
class Robot:
    """An arm with two fingers, and how it is used.

    The frame of `tcp` lies between the finger tips: z points out of the hand, the fingers move along y.
    """

    description: Articulation
    tcp: str
    hand: str
    fingers: tuple[str, str]
    finger_joints: tuple[str, str]
    identity: dict[str, Any] = field(default_factory=dict)
    """JSON-able: equal for equal robots."""
    file_looks: Looks | None = field(default=None, compare=False, repr=False)
    """What the links look like, of a robot whose files were read in a process of their own."""

    @cached_property
    def looks(self) -> Looks:
        """(link, mesh in the link's frame) of every link that is seen."""
        return looks_of(self.description) if self.file_looks is None else self.file_looks

    @cached_property
    def tcp_index(self) -> int:
        """Of the link between the finger tips."""
        return self.description.link_index(self.tcp)

    def gripper(self, world: World, arm: int) -> Gripper:
        """Its fingers in a world."""
        return Gripper(world, arm, joints=self.finger_joints, fingers=self.fingers, hand=self.hand)

    @cached_property
    def ready(self) -> NDArray[np.float64]:
        """float64 [dof]: the hand points down before the base, where the Panda's usual start has it; fingers open.

        Raises:
            ArgumentError: the arm does not come there.
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
def own_panda() -> Robot:
    """The Franka Panda of simple shapes that the project describes itself."""
    return _robot(panda(), PANDA_TCP, {"name": "panda"})


def robot_of(file: str | PathLike[str], tcp: str = "") -> Robot:
    """The robot that a URDF file describes.

    Args:
        file: its description; meshes are found beside it, `package://NAME/...` in the folders above it.
        tcp: the link between the finger tips: z points out of the hand, the fingers move along y. Found by name if "".

    Raises:
        FileError: the file or a mesh is missing or damaged; the message names the link.
        ArgumentError: it has no two fingers, or no such link, or another frame there; the message says what was looked
            for and what there is.
    """
    path = Path(file).expanduser().absolute()
    known = _KNOWN.get((path, tcp))
    if known is not None and known.digest == _digest_of(path, known.meshes):
        return known.robot
    description = read_description(path)
    meshes = tuple(map(Path, description.articulation.meshes))
    digest = _digest_of(path, meshes)
    identity = {"name": path.name, "digest": digest, **({"tcp": tcp} if tcp else {})}
    robot = _robot(description.articulation, tcp, identity, description.looks)
    _ = robot.ready  # an arm that does not come there is refused here
    _KNOWN[path, tcp] = _Known(digest, meshes, robot)
    return robot


@dataclass(frozen=True)
class _Known:
    """A robot, and what it was read from."""

    digest: str
    meshes: tuple[Path, ...]
    robot: Robot


_KNOWN: dict[tuple[Path, str], _Known] = {}
"""By file and link between the finger tips."""


def _digest_of(path: Path, meshes: Sequence[Path]) -> str:
    """Digest of a description and its meshes."""
    state = hashlib.sha256(path.read_bytes() if path.is_file() else b"")
    for mesh in meshes:
        state.update(mesh.read_bytes() if mesh.is_file() else b"")
    return state.hexdigest()[:16]


def _robot(description: Articulation, tcp: str, identity: dict[str, Any], looks: Looks | None = None) -> Robot:
    left, right = _fingers(description)
    hand = left["parent"]
    robot = Robot(
        description,
        tcp or _tool(description, hand),
        hand,
        (left["child"], right["child"]),
        (left["name"], right["name"]),
        identity,
        looks,
    )
    _check_frame(robot)
    return robot


def _fingers(description: Articulation) -> list[dict[str, str]]:
    """The two joints whose links slide on the same one."""
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


def _tool(description: Articulation, hand: str) -> str:
    """The link between the finger tips: fixed to the hand, or to what is fixed to it, and called so."""
    fixed = [hand]
    for joint in description.tree:  # parents come first
        if joint["type"] == "fixed" and joint["parent"] in fixed:
            fixed.append(joint["child"])
    for word in TOOLS:
        for name in fixed[1:]:
            if word in name.lower() if "_" in word else word in re.split(r"[^a-z0-9]+", name.lower()):
                return name
    raise ArgumentError(
        f"robot {description.name}: expected a link between the finger tips, fixed to '{hand}' and with one of the "
        f"words {', '.join(TOOLS)} in its name; name another by robot_tcp=LINK, among {', '.join(description.links)}"
    )


def _check_frame(robot: Robot) -> None:
    """That the frame between the finger tips is turned as poses of the gripper are."""
    description, ends = robot.description, []
    for end in ("lower", "upper"):
        limits = description.limits
        positions = np.clip(0, limits["lower"], limits["upper"])
        for joint in robot.finger_joints:
            positions[description.joint_index(joint)] = limits[end][description.joint_index(joint)]
        ends.append(description.forward_kinematics(positions))
    tip = np.linalg.inv(ends[0][robot.tcp_index])
    way = tip[:3, :3] @ (ends[1] - ends[0])[description.link_index(robot.fingers[0]), :3, 3]
    behind = (tip @ ends[0][description.link_index(robot.hand)])[2, 3]
    if abs(way[1]) < 0.99 * np.linalg.norm(way) or not np.linalg.norm(way) or behind >= 0:
        raise ArgumentError(
            f"robot {description.name}: expected '{robot.tcp}' as a frame between the finger tips with z out of the "
            f"hand and the fingers moving along y; they move along {np.round(way, 3).tolist()} m, the hand's frame "
            f"lies {behind:+.3f} m along z; name another by robot_tcp=LINK"
        )
