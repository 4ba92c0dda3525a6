# SPDX-License-Identifier: Apache-2.0
"""Plans of a gripper: drawn on a fixed camera's image, and as symbols."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import groupby
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from wiw.report.maps import Mark, Trail
from wiw.tabletop.workbench import SHUT, Camera

Plan = Sequence[Sequence[float]]
"""Poses [K, 7]."""

AROUND = "→↘↓↙←↖↑↗"
"""Ways along the table as the camera sees them, which looks at the arm: +y to the right, +x towards it."""
UP, DOWN, GRIPS, LETS_GO, STAYS = "↥", "↧", "●", "○", "·"
STILL = 0.005
"""Metres that do not count as motion."""
SINGLE = 8
"""Poses of which each has a sign of its own and a mark; of longer plans only what changes."""
SIDE = 100
"""Units of a drawing's sides."""


@dataclass(frozen=True)
class Stop:
    """A pose of a plan in the picture, and the place on the table below it."""

    place: tuple[float, ...]
    """x and y."""
    foot: tuple[float, ...]
    shut: bool
    number: int
    """Counted from 1."""


@dataclass(frozen=True)
class Drawing:
    """A plan in the picture."""

    points: str
    """For an SVG polyline, from where the gripper was."""
    stops: tuple[Stop, ...]


@dataclass(frozen=True)
class Stage:
    """A fixed camera's view of a table, `SIDE` units wide and high."""

    camera: Camera
    ground: float
    """Height of the table's top."""

    def pixels(self, points: ArrayLike) -> NDArray[np.float64]:
        """Return float64 [N, 2] of world points [N, 3]."""
        return self.camera.project_points(points, (SIDE, SIDE))

    def draw(self, start: Sequence[float], plan: Plan) -> Drawing:
        """Return the drawing of a plan from the gripper's position `start`."""
        way = np.array([start, *(pose[:3] for pose in plan)], np.float64)
        seen, feet = self.pixels(way), self.pixels(np.c_[way[:, :2], np.full(len(way), self.ground)])
        shut = [pose[6] < SHUT for pose in plan]
        turns = [k for k in range(len(plan)) if k + 1 == len(plan) or (k and shut[k] != shut[k - 1])]
        shown = range(len(plan)) if len(plan) <= SINGLE else turns
        stops = tuple(Stop(tuple(seen[k + 1].tolist()), tuple(feet[k + 1].tolist()), shut[k], k + 1) for k in shown)
        return Drawing(_format_points(seen), stops)

    def trail(self, arm: str, decisions: Sequence[Mapping[str, Any]]) -> Trail:
        """Return the path that the decisions of one episode took, with a stop where each starts."""
        way = self.pixels(np.concatenate([np.asarray(row["path"], np.float64) for row in decisions]))
        ends = [(row["before_x"], row["before_y"], row["before_z"]) for row in decisions]
        ends.append(tuple(decisions[-1][f"after_{axis}"] for axis in "xyz"))
        return Trail(arm, _format_points(way), tuple(Mark(float(x), float(y), 0.0) for x, y in self.pixels(ends)))


def read_stage(info: Mapping[str, Any]) -> Stage | None:
    """Return the stage that a run's information describes, if its task has one."""
    kept = info.get("stage")
    return None if kept is None else Stage(Camera(**kept["camera"]), float(kept["ground"]))


def _format_points(pixels: NDArray[np.float64]) -> str:
    """Return points [N, 2] as SVG text."""
    return " ".join(f"{x:.1f},{y:.1f}" for x, y in pixels)


def format_signs(plan: Plan, start: Sequence[float], shut: bool = False) -> str:
    """Return a plan as arrows, with marks where the gripper closes and opens: "↘ ↧● ↥ ← ↧○".

    Args:
        plan: poses [K, 7].
        start: where the gripper is, [3] or more.
        shut: whether it is closed.
    """
    found, here = list[str](), start
    for pose in plan:
        closes = pose[6] < SHUT
        found.append(_find_sign(here, pose) + ("" if closes == shut else GRIPS if closes else LETS_GO))
        here, shut = pose[:3], closes
    return " ".join(found if len(plan) <= SINGLE else [sign for sign, _ in groupby(found)])


def _find_sign(here: Sequence[float], pose: Sequence[float]) -> str:
    ahead, right, up = np.subtract(pose[:3], here[:3])
    along = np.hypot(ahead, right)
    if max(along, abs(up)) < STILL:
        return STAYS
    if abs(up) > along:
        return UP if up > 0 else DOWN
    return AROUND[round(np.arctan2(ahead, right) / (np.pi / 4)) % 8]
