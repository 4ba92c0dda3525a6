# SPDX-License-Identifier: Apache-2.0
"""What is known before anything is learnt: the arm's own body, its camera and the bare table.

A robot knows its description and where its camera stands. So the arm at any pose is drawn, over the bare table and with
its shadow, and only what happens to things is left to a network. Nothing here sees the table that plans are made for.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache

import numpy as np
from numpy.typing import NDArray

from wiw.tabletop.workbench import Workbench

NEARER = 1e-3
"""Metres that the arm is nearer to the camera than the bare table where it hides it."""


@dataclass(frozen=True)
class ArmView:
    """The arm over the bare table."""

    color: NDArray[np.uint8]
    """[H, W, 3]."""
    arm: NDArray[np.bool_]
    """[H, W]: where it hides the table."""
    pose: NDArray[np.float64]
    """float64 [7]: the gripper's actual pose, which may differ from the commanded one."""


@cache
def _bare() -> Workbench:
    return Workbench([])


@cache
def render_bare_table(size: tuple[int, int]) -> ArmView:
    """Return the front view of the bare table without an arm."""
    seen = _bare().render_view("front", size, arm=False)
    seen["color"].setflags(write=False)
    return ArmView(seen["color"], np.zeros(size, np.bool_), np.full(7, np.nan))


@cache
def _depth(size: tuple[int, int]) -> NDArray[np.float32]:
    depth: NDArray[np.float32] = _bare().render_view("front", size, ("depth",), arm=False)["depth"]
    return depth


def render_arm(poses: NDArray[np.float64], size: tuple[int, int]) -> Iterator[ArmView]:
    """Yield the view of the arm after it has moved to each of the poses [N, 7] in turn, from its start pose."""
    bench = _bare().fork()
    for pose in poses:
        bench.move_to(np.clip(pose, *_RANGE))
        seen = bench.render_view("front", size, ("color", "depth"))
        yield ArmView(seen["color"], seen["depth"] < _depth(size) - NEARER, bench.pose)


_RANGE = np.array([[-np.inf] * 6 + [0.0], [np.inf] * 6 + [1.0]])
"""A gripper that has been measured may be open by a hair more than all."""
