# SPDX-License-Identifier: Apache-2.0
"""How pages show plans and their outcomes: primitives on panoramas, poses on a fixed camera's images, or plans of a
space of the user's own.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from wiw.action import FORWARD, STOP, TURN_LEFT, TURN_RIGHT
from wiw.report import cuts
from wiw.report.stage import Drawing, Stage, format_signs
from wiw.report.story import Album
from wiw.tabletop.workbench import SHUT

GLYPHS = {int(FORWARD): "↑", int(TURN_LEFT): "↖", int(TURN_RIGHT): "↗", int(STOP): "■"}


class Primitives:
    """Plans of primitives."""

    view = "panorama"
    """Name of the picture of what the agent saw."""

    def text(self, plan: Sequence[int]) -> str:
        """Return a plan as a few symbols."""
        return format_glyphs(plan)

    def drawing(self, plan: Sequence[int]) -> Drawing | None:
        """Return a plan's drawing; None for primitives."""
        return None

    def observation(self, jpeg: bytes, album: Album) -> bytes:
        """Return the observation as WebP bytes for the album."""
        return cuts.panorama(jpeg, album.panorama_width, album.quality, album.scale)

    def strip(self, jpeg: bytes, frames: int, album: Album) -> bytes:
        """Return an imagined or true future as WebP bytes for the album."""
        return cuts.strip(jpeg, frames, album.frame_height, album.quality, album.scale)


class Numbers(Primitives):
    """Plans of a custom plan space, shown as numbers."""

    def text(self, plan: Sequence[Any]) -> str:
        """Return a plan as numbers."""
        return numbers(plan)


@dataclass(frozen=True)
class Poses:
    """Plans of poses of a gripper."""

    stage: Stage | None
    """Nothing is drawn without one."""
    start: Sequence[float]
    """Where the gripper was, [3]."""
    shut: bool
    """Whether it was closed."""
    view = "front"

    def text(self, plan: Sequence[Sequence[float]]) -> str:
        """Return a plan as a few symbols."""
        return format_signs(plan, self.start, self.shut)

    def drawing(self, plan: Sequence[Sequence[float]]) -> Drawing | None:
        """Return a plan's drawing on the camera image."""
        return None if self.stage is None else self.stage.draw(self.start, plan)

    def observation(self, jpeg: bytes, album: Album) -> bytes:
        """Return the camera image as WebP bytes for the album."""
        return cuts.cut_front(jpeg, album.front_side, album.quality, album.scale)

    def strip(self, jpeg: bytes, frames: int, album: Album) -> bytes:
        """Return an imagined or true future as WebP bytes: every frame without a gap, or the last one."""
        return cuts.cut_frames(jpeg, frames, album.end_side, album.quality, album.whole, album.scale)


def plan_views(decisions: Iterable[Mapping[str, Any]], stage: Stage | None) -> list[Primitives | Poses]:
    """Return for each decision of an episode how it is shown."""
    found: list[Primitives | Poses] = []
    shut = False
    for row in decisions:
        if not is_pose_row(row):
            found.append(Primitives() if is_primitive_plan(row["actions"]) else Numbers())
            continue
        found.append(Poses(stage, (row["before_x"], row["before_y"], row["before_z"]), shut))
        shut = row["executed"][-1][6] < SHUT if row["executed"] else shut
    return found


def is_pose_row(row: Mapping[str, Any]) -> bool:
    """Return whether a decision plans poses of a gripper, vectors of 7 numbers."""
    first = row["actions"][0]
    return isinstance(first, list) and len(first) == 7


def is_primitive_plan(plan: Sequence[Any]) -> bool:
    """Return whether a plan is made of primitives, whole numbers."""
    return isinstance(plan[0], int)


def numbers(plan: Sequence[Any]) -> str:
    """Return the actions of a plan as numbers, those of a vector in brackets: "0.5, -0.25" or "(1, 0), (0, 1)"."""
    return ", ".join(f"({numbers(action)})" if isinstance(action, list) else f"{action:.3g}" for action in plan)


def format_glyphs(actions: Sequence[int]) -> str:
    """Return primitives as arrows; ids without one as numbers."""
    return "".join(GLYPHS.get(action, f"({action})") for action in actions)
