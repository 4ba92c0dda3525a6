# SPDX-License-Identifier: Apache-2.0
"""Sensors of a manipulator: cameras and joints, as gymnasium knows them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from wiw.errors import ArgumentError
from wiw.render import Output
from wiw.tabletop.cloud import unproject_depth
from wiw.tabletop.workbench import CAMERAS, Workbench

NOTHING: Mapping[str, Any] = MappingProxyType({})
ROOM, ARM = 0, 255
"""Ids of what is not an object; those are numbered from 1."""


@dataclass(frozen=True)
class Sensors:
    """Cameras and what they give; all of them have pictures of one size.

    The front camera is always among them and its names are bare ("front", "depth", "ids"); another's are "wrist",
    "wrist_depth", "wrist_ids".
    """

    size: int = 480
    """Pixels of a side."""
    cameras: tuple[str, ...] = ()
    """Besides the front one, names of `wiw.tabletop.workbench.CAMERAS`."""
    depth: bool = False
    ids: bool = False
    cloud: bool = False
    joints: int = 9
    """Number of joints, of the arm and its fingers."""

    def __post_init__(self) -> None:
        if unknown := [name for name in self.cameras if name not in CAMERAS]:
            raise ArgumentError(f"cameras: expected some of {', '.join(CAMERAS)}, got {', '.join(unknown)}")
        if not isinstance(self.size, int | np.integer) or self.size < 1:
            raise ArgumentError(f"size: expected a whole number of pixels, at least one, got {self.size!r}")

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the cameras, the front one first."""
        return tuple(dict.fromkeys(["front", *self.cameras]))

    @property
    def outputs(self) -> tuple[Output, ...]:
        """Images that each camera draws."""
        depth: tuple[Output, ...] = ("depth",) if self.depth or self.cloud else ()
        return ("color", *depth, *(("instance",) if self.ids else ()))

    def space(self) -> spaces.Dict:
        """Return the space of observations."""
        shape = (self.size, self.size)
        count = len(self.names) * self.size**2
        seen: dict[str, spaces.Space[Any]] = {
            "pose": spaces.Box(-np.inf, np.inf, (7,), np.float64),
            "joints": spaces.Box(-np.inf, np.inf, (self.joints,), np.float64),
            "held": spaces.Discrete(2),
        }
        for name in self.names:
            seen[name] = spaces.Box(0, 255, (*shape, 3), np.uint8)
            if self.depth:
                seen[_key(name, "depth")] = spaces.Box(0, np.inf, shape, np.float32)
            if self.ids:
                seen[_key(name, "ids")] = spaces.Box(0, 255, shape, np.uint8)
        if self.cloud:
            seen["points"] = spaces.Box(-np.inf, np.inf, (count, 3), np.float32)
            seen["colors"] = spaces.Box(0, 255, (count, 3), np.uint8)
        return spaces.Dict(seen)

    def pictures(self, bench: Workbench, camera: str = "front") -> dict[str, NDArray[Any]]:
        """Return the images of one camera: those of "color", "depth" and "instance" that are requested."""
        return bench.render_view(camera, (self.size, self.size), self.outputs)

    def read(
        self, bench: Workbench, objects: Sequence[str], drawn: Mapping[str, dict[str, NDArray[Any]]] = NOTHING
    ) -> dict[str, Any]:
        """Return an observation in `space`.

        Args:
            bench: what is looked at.
            objects: names of what has an id of its own, from 1 on.
            drawn: `pictures` of cameras that are drawn already.
        """
        drawn = {name: drawn[name] if name in drawn else self.pictures(bench, name) for name in self.names}
        values: dict[str, Any] = {
            "pose": bench.pose,
            "joints": bench.joints,
            "held": np.int64(bench.held_object is not None),
        }
        for name, images in drawn.items():
            values[name] = images["color"]
            if self.depth:
                values[_key(name, "depth")] = images["depth"]
            if self.ids:
                values[_key(name, "ids")] = _numbers(bench, objects)[images["instance"]]
        if self.cloud:
            clouds = [
                unproject_depth(images["depth"], CAMERAS[name].hfov_deg, bench.get_camera_pose(name)).reshape(-1, 3)
                for name, images in drawn.items()
            ]
            values["points"] = np.concatenate(clouds)
            values["colors"] = np.concatenate([images["color"].reshape(-1, 3) for images in drawn.values()])
        return values


def _key(camera: str, what: str) -> str:
    return what if camera == "front" else f"{camera}_{what}"


def _numbers(bench: Workbench, objects: Sequence[str]) -> NDArray[np.uint8]:
    """By instance id, the number that observations have for it."""
    known = {"arm": ARM, **{name: number for number, name in enumerate(objects, start=1)}}
    return np.array([ROOM, *(known.get(name, ROOM) for name in bench.instance_names)], np.uint8)
