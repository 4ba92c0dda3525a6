# SPDX-License-Identifier: Apache-2.0
"""Training data of warpnet: panoramas along straight walks; any two of a walk are one example of moving ahead."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from wiw._core import core
from wiw.datasets.cameras import camera_pose
from wiw.datasets.worlds import World
from wiw.errors import ArgumentError

OVERSAMPLING = 4
"""Rays per row and column of a pixel, so that small panoramas are as smooth as downsampled large ones."""
PROBE_SPACING = 0.1
"""Metres between the points of a path that are tested for obstacles."""


@dataclass(frozen=True)
class WalkRules:
    """Rules for sampling a scene. Lengths in metres."""

    places: int = 24
    """Straight walks in a scene."""
    stops: int = 4
    """Panoramas of a walk: at both ends and in between."""
    shortest: float = 1.0
    longest: float = 2.4
    height: int = 72
    """Rows of the panoramas, which are twice as wide."""
    tries: int = 20
    """Candidate paths for each path that is wanted."""


@dataclass(frozen=True)
class Walks:
    """N walks with S panoramas each, all facing ahead."""

    images: NDArray[np.uint8]
    """uint8 [N, S, H, W, 3]."""
    distances: NDArray[np.float16]
    """float16 [N, S, H, W]: metres along the ray, 0 where nothing is hit."""
    places: NDArray[np.float32]
    """float32 [N, S]: metres along the walk, ascending."""

    def __len__(self) -> int:
        return len(self.places)


def merge_walks(parts: Sequence[Walks]) -> Walks:
    """Concatenate the walks of several scenes.

    Raises:
        ArgumentError: there is not one walk in them.
    """
    if not sum(map(len, parts)):
        raise ArgumentError(
            "expected scenes in which an agent can walk straight ahead, got none; choose others (--scenes)"
        )
    return Walks(
        *(np.concatenate([getattr(part, name) for part in parts]) for name in ("images", "distances", "places"))
    )


def record_walks(world: World, seed: int, rules: WalkRules = WalkRules()) -> Walks:
    """Record walks through a scene; a pure function of (scene, seed, rules)."""
    key = core.fold_key([seed, 0x4C10])
    size = (rules.height, 2 * rules.height)
    paths = find_straight_paths(world, rules.places, key, rules.shortest, rules.longest, rules.tries)
    between = np.sort(core.uniform(core.fold_key([key, 2]), len(paths) * rules.stops).reshape(len(paths), -1), axis=1)
    between[:, 0], between[:, -1] = 0, 1
    images = np.empty((len(paths), rules.stops, *size, 3), np.uint8)
    distances = np.empty((len(paths), rules.stops, *size), np.float16)
    places = np.empty((len(paths), rules.stops), np.float32)
    for row, (path, shares) in enumerate(zip(paths, between, strict=True)):
        places[row] = shares * path.length
        poses = path.camera_poses(world, places[row])
        fine = world.renderer.panorama(poses, (OVERSAMPLING * size[0], OVERSAMPLING * size[1]), outputs=("color",))
        for column, image in enumerate(fine["color"]):
            images[row, column] = cv2.resize(image, size[::-1], interpolation=cv2.INTER_AREA)
        distances[row] = world.renderer.panorama(poses, size, outputs=("depth",))["depth"]
    return Walks(images, distances, places)


@dataclass(frozen=True)
class StraightPath:
    """A straight path without obstacles."""

    start: NDArray[np.float64]
    heading: float
    length: float

    def camera_poses(self, world: World, places: NDArray[np.floating]) -> NDArray[np.float64]:
        """Return the cameras at some distances along the path, float64 [N, 4, 4], at camera height above the rendered
        floor.
        """
        spots = self.start + np.asarray(places, np.float64)[:, None] * _compute_directions(np.array([self.heading]))
        return np.stack([camera_pose(spot, self.heading) for spot in world.ground.put_down(spots).astype(np.float64)])


def find_straight_paths(
    world: World, count: int, key: int, shortest: float, longest: float, tries: int = 20
) -> list[StraightPath]:
    """Find up to `count` paths that start all over a scene, each as long as it is free, at most `longest`."""
    starts = world.navmesh.sample(tries * count, key, world.floor).astype(np.float64)
    headings = 2 * np.pi * core.uniform(core.fold_key([key, 1]), len(starts))
    steps = np.arange(1, round(longest / PROBE_SPACING) + 1) * PROBE_SPACING
    probes = starts[:, None] + steps[:, None] * _compute_directions(headings)[:, None]
    free = world.navmesh.is_navigable(probes.reshape(-1, 3)).reshape(len(starts), -1)
    lengths = np.where(free.all(axis=1), len(steps), free.argmin(axis=1)) * PROBE_SPACING
    chosen = np.flatnonzero(lengths > shortest - PROBE_SPACING / 2)[:count]
    return [StraightPath(starts[i], float(headings[i]), float(lengths[i])) for i in chosen]


def _compute_directions(headings: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return unit vectors float64 [N, 3] of headings in radians to the left of -Z."""
    return np.stack([-np.sin(headings), np.zeros(len(headings)), -np.cos(headings)], axis=1)
