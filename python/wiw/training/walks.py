# SPDX-License-Identifier: Apache-2.0
"""What warpnet learns from: panoramas along straight ways, every two of which are a lesson in going straight ahead."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from wiw._core import core
from wiw.datasets.imagenav import camera_pose
from wiw.datasets.worlds import World
from wiw.errors import ArgumentError

OVERSAMPLED = 4
"""Rays per row and column of a pixel, so that small panoramas are as smooth as large ones made smaller."""
PROBES = 0.1
"""Metres between the places of a way that are asked whether they are free."""


@dataclass(frozen=True)
class WalkRules:
    """Where a scene is walked through. Lengths in metres."""

    places: int = 24
    """Straight ways in a scene."""
    stops: int = 4
    """Panoramas of a way: at both ends and between."""
    shortest: float = 1.0
    longest: float = 2.4
    height: int = 72
    """Rows of the panoramas, which are twice as wide."""
    tries: int = 20
    """Ways that are looked at for each that is taken."""


@dataclass(frozen=True)
class Walks:
    """N ways with S panoramas each, headed along the way."""

    images: NDArray[np.uint8]
    """uint8 [N, S, H, W, 3]."""
    distances: NDArray[np.float16]
    """float16 [N, S, H, W]: metres along the ray, 0 where nothing is hit."""
    places: NDArray[np.float32]
    """float32 [N, S]: metres along the way, ascending."""

    def __len__(self) -> int:
        return len(self.places)


def merged(parts: Sequence[Walks]) -> Walks:
    """All ways of several scenes.

    Raises:
        ArgumentError: there is not one way in them.
    """
    if not sum(map(len, parts)):
        raise ArgumentError("expected scenes in which one can walk straight ahead, got none; name others (--scenes)")
    return Walks(
        *(np.concatenate([getattr(part, name) for part in parts]) for name in ("images", "distances", "places"))
    )


def walk_about(world: World, seed: int, rules: WalkRules = WalkRules()) -> Walks:
    """Ways through a scene: a function of (scene, seed, rules)."""
    key = core.fold_key([seed, 0x4C10])
    size = (rules.height, 2 * rules.height)
    ways = straight_ways(world, rules.places, key, rules.shortest, rules.longest, rules.tries)
    between = np.sort(core.uniform(core.fold_key([key, 2]), len(ways) * rules.stops).reshape(len(ways), -1), axis=1)
    between[:, 0], between[:, -1] = 0, 1
    images = np.empty((len(ways), rules.stops, *size, 3), np.uint8)
    distances = np.empty((len(ways), rules.stops, *size), np.float16)
    places = np.empty((len(ways), rules.stops), np.float32)
    for row, (way, shares) in enumerate(zip(ways, between, strict=True)):
        places[row] = shares * way.length
        poses = way.poses(world, places[row])
        fine = world.renderer.panorama(poses, (OVERSAMPLED * size[0], OVERSAMPLED * size[1]), outputs=("color",))
        for column, image in enumerate(fine["color"]):
            images[row, column] = cv2.resize(image, size[::-1], interpolation=cv2.INTER_AREA)
        distances[row] = world.renderer.panorama(poses, size, outputs=("depth",))["depth"]
    return Walks(images, distances, places)


@dataclass(frozen=True)
class Way:
    """A straight way that is free."""

    start: NDArray[np.float64]
    heading: float
    length: float

    def poses(self, world: World, places: NDArray[np.floating]) -> NDArray[np.float64]:
        """float64 [N, 4, 4]: cameras so many metres along it, on the floor that is drawn."""
        spots = self.start + np.asarray(places, np.float64)[:, None] * _ahead(np.array([self.heading]))
        return np.stack([camera_pose(spot, self.heading) for spot in world.ground.put_down(spots).astype(np.float64)])


def straight_ways(world: World, count: int, key: int, shortest: float, longest: float, tries: int = 20) -> list[Way]:
    """Up to `count` ways from places all over a scene, each as long as is free, cut at `longest`."""
    starts = world.navmesh.sample(tries * count, key).astype(np.float64)
    headings = 2 * np.pi * core.uniform(core.fold_key([key, 1]), len(starts))
    steps = np.arange(1, round(longest / PROBES) + 1) * PROBES
    probes = starts[:, None] + steps[:, None] * _ahead(headings)[:, None]
    free = world.navmesh.is_navigable(probes.reshape(-1, 3)).reshape(len(starts), -1)
    lengths = np.where(free.all(axis=1), len(steps), free.argmin(axis=1)) * PROBES
    chosen = np.flatnonzero(lengths > shortest - PROBES / 2)[:count]
    return [Way(starts[i], float(headings[i]), float(lengths[i])) for i in chosen]


def _ahead(headings: NDArray[np.float64]) -> NDArray[np.float64]:
    """float64 [N, 3]: unit vectors, headings in radians to the left of -Z."""
    return np.stack([-np.sin(headings), np.zeros(len(headings)), -np.cos(headings)], axis=1)
