# SPDX-License-Identifier: Apache-2.0
"""What the recogniser learns from: things seen from a place, truly and in imagination from places near by."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from wiw._core import core
from wiw.datasets.ar import CATEGORIES, category_of
from wiw.datasets.imagenav import camera_pose
from wiw.datasets.visibility import COARSE, measure_sizes
from wiw.datasets.worlds import World
from wiw.errors import ArgumentError
from wiw.perception.glimpses import Glimpses, glimpses, joined
from wiw.perception.tracking import moved_masks, without_specks
from wiw.reproject import warp

START, NEAR, PERFECT, WARPED = 0, 1, 2, 3
"""Kinds of looks: from the place itself; from one near by, as an agent that went there would see it; and as a perfect
world model or reprojection would let it imagine that, with the box that the tracker gives."""


@dataclass(frozen=True)
class LookRules:
    """Where a scene is looked at from. Lengths in metres."""

    places: int = 16
    targets: int = 5
    """Most things looked at from a place; those of categories that are rare so far come first."""
    neighbours: int = 3
    reach: tuple[float, float] = (0.25, 0.8)
    """Of the neighbours: the second is what four primitives come to."""
    smallest: float = 0.0015
    """Steradians of the least target, 45 pixels of the panorama."""
    survey: int = 150
    """Places that are chosen from."""


@dataclass(frozen=True)
class Looks:
    """Sets of looks, each at one thing from one place and its neighbours."""

    glimpses: Glimpses
    """Of all sets, one after the other; the real ones among them are marked so."""
    owners: NDArray[np.int64]
    """int64 [looks]: which set each is of, ascending."""
    kinds: NDArray[np.int64]
    """int64 [looks]: `START`, `NEAR`, `PERFECT` or `WARPED`; each set begins with its one `START`."""
    labels: NDArray[np.int64]
    """int64 [sets]: numbers of categories."""

    def __len__(self) -> int:
        return len(self.labels)


def merged(parts: Sequence[Looks]) -> Looks:
    """All sets of several scenes.

    Raises:
        ArgumentError: there is not one set in them.
    """
    counts = [len(part) for part in parts]
    if not sum(counts):
        raise ArgumentError("expected scenes that show things of the categories, got none; name others (--scenes)")
    shifts = np.cumsum([0, *counts[:-1]])
    return Looks(
        joined([part.glimpses for part in parts]),
        np.concatenate([part.owners + shift for part, shift in zip(parts, shifts, strict=True)]),
        np.concatenate([part.kinds for part in parts]),
        np.concatenate([part.labels for part in parts]),
    )


def halves(looks: Looks) -> tuple[Looks, Looks]:
    """The first half of the sets and the second: other scenes, as sets come scene by scene.

    Raises:
        ArgumentError: there is but one set.
    """
    middle = len(looks) // 2
    if not middle:
        raise ArgumentError("expected at least two sets of looks to calibrate with and to measure on; name more scenes")
    cut = int(np.searchsorted(looks.owners, middle))
    rows = np.arange(len(looks.owners))
    return (
        Looks(looks.glimpses[rows[:cut]], looks.owners[:cut], looks.kinds[:cut], looks.labels[:middle]),
        Looks(looks.glimpses[rows[cut:]], looks.owners[cut:] - middle, looks.kinds[cut:], looks.labels[middle:]),
    )


def look_around(
    world: World, seed: int, categories: Sequence[str] = CATEGORIES, rules: LookRules = LookRules()
) -> Looks:
    """Looks at a scene's things: a function of (scene, seed, categories, rules)."""
    numbers = {name: i for i, name in enumerate(categories)}
    labels = np.array([-1, *(numbers.get(category_of(thing), -1) for thing in world.scene.instances)])
    key = core.fold_key([seed, 0x4C00])
    points = world.ground.put_down(world.navmesh.sample(rules.survey, key)).astype(np.float64)
    sizes = np.where(labels >= 0, measure_sizes(world, points, COARSE), 0.0)
    tally: Counter[int] = Counter()
    parts: list[Looks] = []
    for number in range(rules.places):
        place = _next_place(sizes, labels, tally, rules)
        if place is None:
            break
        parts += _from_place(world, points[place], labels, tally, core.fold_key([key, number]), rules)
        sizes[place] = 0
    if not parts:
        return Looks(joined([]), np.zeros(0, np.int64), np.zeros(0, np.int64), np.zeros(0, np.int64))
    return merged(parts)


def _next_place(
    sizes: NDArray[np.float64], labels: NDArray[np.int64], tally: Counter[int], rules: LookRules
) -> int | None:
    """The first place that shows what was looked at least often so far."""
    visible = sizes >= rules.smallest
    shown = np.flatnonzero(visible.any(axis=0))
    if not len(shown):
        return None
    rarest = min(shown, key=lambda thing: (tally[int(labels[thing])], labels[thing], thing))
    return int(np.flatnonzero(visible[:, rarest])[0])


def _from_place(
    world: World,
    point: NDArray[np.float64],
    labels: NDArray[np.int64],
    tally: Counter[int],
    key: int,
    rules: LookRules,
) -> list[Looks]:
    """One set for each of the things chosen."""
    poses = np.stack([camera_pose(spot, 0.0) for spot in [point, *_neighbours(world, point, key, rules)]])
    shown = world.renderer.panorama(poses)
    color, depth, ids = shown["color"], shown["depth"][0], shown["instance"]
    relative = np.linalg.inv(poses[0]) @ poses[1:]
    imagined = warp(color[:1], depth[None], relative[None])[0] if len(relative) else color[1:]
    panoramas = np.concatenate([color, color[1:], imagined])
    kinds = np.repeat([START, NEAR, PERFECT, WARPED], [1, *[len(relative)] * 3])
    things = _things(ids[0], labels, tally, rules)
    if not things:
        return []
    here = np.array([ids[0] == thing for thing in things])
    moved = moved_masks(here, depth, relative, depth.shape)[0] if len(relative) else here[:, None][:, :0]
    sets = []
    for thing, masks in zip(things, moved, strict=True):
        tracked = without_specks(masks)
        found, frames = glimpses(panoramas, np.concatenate([ids == thing, tracked, tracked]), kinds <= NEAR)
        sets.append(Looks(found, np.zeros(len(frames), np.int64), kinds[frames], labels[[thing]]))
        tally[int(labels[thing])] += 1
    return sets


def _neighbours(world: World, point: NDArray[np.float64], key: int, rules: LookRules) -> NDArray[np.float64]:
    """Places that a straight way leads to."""
    draws = core.uniform(core.fold_key([key, 1]), 2 * 8 * max(1, rules.neighbours)).reshape(-1, 2)
    angles, lengths = 2 * np.pi * draws[:, 0], rules.reach[0] + np.ptp(rules.reach) * draws[:, 1]
    ways = np.stack([np.sin(angles), np.zeros(len(angles)), np.cos(angles)], axis=1) * lengths[:, None]
    middle, ends = point + ways / 2, point + ways
    free = world.navmesh.is_navigable(middle) & world.navmesh.is_navigable(ends)
    return world.ground.put_down(ends[free][: rules.neighbours]).astype(np.float64)


def _things(ids: NDArray[np.uint32], labels: NDArray[np.int64], tally: Counter[int], rules: LookRules) -> list[int]:
    """Instances that are large enough from the place itself, those of rare categories first."""
    rows, columns = ids.shape
    weights = np.cos(np.pi * ((np.arange(rows) + 0.5) / rows - 0.5)) * 2 * np.pi**2 / rows / columns
    sizes = np.bincount(ids.ravel(), np.repeat(weights, columns), len(labels))
    large = np.flatnonzero((sizes >= rules.smallest) & (labels >= 0))
    rank = sorted(large, key=lambda thing: (tally[int(labels[thing])], -sizes[thing]))
    return [int(thing) for thing in rank[: rules.targets]]
