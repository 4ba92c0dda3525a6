# SPDX-License-Identifier: Apache-2.0
"""Training data of the recogniser: objects seen from a place, and from places nearby, really and in imagination."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from wiw._core import core
from wiw.datasets.ar import CATEGORIES, category_of
from wiw.datasets.cameras import camera_pose
from wiw.datasets.visibility import COARSE, measure_sizes
from wiw.datasets.worlds import World
from wiw.errors import ArgumentError
from wiw.perception.glimpses import Glimpses, extract_glimpses, join_glimpses
from wiw.perception.tracking import remove_specks, reproject_masks
from wiw.reproject import warp

START, NEAR, PERFECT, WARPED = 0, 1, 2, 3
"""Kinds of glimpses: from the place itself; really seen from a place nearby; imagined from there by a perfect world
model; imagined by reprojection. The box of an imagined glimpse is the tracker's.
"""


@dataclass(frozen=True)
class GlimpseSetRules:
    """How a scene is sampled. Lengths in metres."""

    places: int = 16
    targets: int = 5
    """Most objects observed from a place; those of rare categories come first."""
    neighbours: int = 3
    reach: tuple[float, float] = (0.25, 0.8)
    """Least and greatest distance of the neighbours; the second is the length of four steps."""
    smallest: float = 0.0015
    """Least solid angle of a target in steradians, 45 pixels of the panorama."""
    survey: int = 150
    """Number of candidate places."""


@dataclass(frozen=True)
class GlimpseSets:
    """Sets of glimpses, each of one object from one place and its neighbours."""

    glimpses: Glimpses
    """The glimpses of all sets, one set after the other; the real ones are marked."""
    owners: NDArray[np.int64]
    """int64 [glimpses]: index of each glimpse's set, ascending."""
    kinds: NDArray[np.int64]
    """int64 [glimpses]: `START`, `NEAR`, `PERFECT` or `WARPED`; each set begins with its one `START`."""
    labels: NDArray[np.int64]
    """int64 [sets]: indices of categories."""

    def __len__(self) -> int:
        return len(self.labels)


def merge_glimpse_sets(parts: Sequence[GlimpseSets]) -> GlimpseSets:
    """Concatenate the sets of several scenes.

    Raises:
        ArgumentError: there is not one set in them.
    """
    counts = [len(part) for part in parts]
    if not sum(counts):
        raise ArgumentError("expected scenes that show things of the categories, got none; name others (--scenes)")
    shifts = np.cumsum([0, *counts[:-1]])
    return GlimpseSets(
        join_glimpses([part.glimpses for part in parts]),
        np.concatenate([part.owners + shift for part, shift in zip(parts, shifts, strict=True)]),
        np.concatenate([part.kinds for part in parts]),
        np.concatenate([part.labels for part in parts]),
    )


def split_in_half(data: GlimpseSets) -> tuple[GlimpseSets, GlimpseSets]:
    """Split the sets into a first and a second half, which show different scenes, as sets are ordered by scene.

    Raises:
        ArgumentError: there is only one set.
    """
    middle = len(data) // 2
    if not middle:
        raise ArgumentError("expected at least two glimpse sets, for calibration and evaluation; name more scenes")
    cut = int(np.searchsorted(data.owners, middle))
    rows = np.arange(len(data.owners))
    return (
        GlimpseSets(data.glimpses[rows[:cut]], data.owners[:cut], data.kinds[:cut], data.labels[:middle]),
        GlimpseSets(data.glimpses[rows[cut:]], data.owners[cut:] - middle, data.kinds[cut:], data.labels[middle:]),
    )


def collect_glimpse_sets(
    world: World, seed: int, categories: Sequence[str] = CATEGORIES, rules: GlimpseSetRules = GlimpseSetRules()
) -> GlimpseSets:
    """Collect glimpses of a scene's objects; a pure function of (scene, seed, categories, rules)."""
    numbers = {name: i for i, name in enumerate(categories)}
    labels = np.array([-1, *(numbers.get(category_of(thing), -1) for thing in world.scene.instances)])
    key = core.fold_key([seed, 0x4C00])
    points = world.ground.put_down(world.navmesh.sample(rules.survey, key)).astype(np.float64)
    sizes = np.where(labels >= 0, measure_sizes(world, points, COARSE), 0.0)
    tally: Counter[int] = Counter()
    parts: list[GlimpseSets] = []
    for number in range(rules.places):
        place = _choose_place(sizes, labels, tally, rules)
        if place is None:
            break
        parts += _collect_at_place(world, points[place], labels, tally, core.fold_key([key, number]), rules)
        sizes[place] = 0
    if not parts:
        return GlimpseSets(join_glimpses([]), np.zeros(0, np.int64), np.zeros(0, np.int64), np.zeros(0, np.int64))
    return merge_glimpse_sets(parts)


def _choose_place(
    sizes: NDArray[np.float64], labels: NDArray[np.int64], tally: Counter[int], rules: GlimpseSetRules
) -> int | None:
    """Return the first place that shows an object of the category sampled least often so far."""
    visible = sizes >= rules.smallest
    shown = np.flatnonzero(visible.any(axis=0))
    if not len(shown):
        return None
    rarest = min(shown, key=lambda thing: (tally[int(labels[thing])], labels[thing], thing))
    return int(np.flatnonzero(visible[:, rarest])[0])


def _collect_at_place(
    world: World,
    point: NDArray[np.float64],
    labels: NDArray[np.int64],
    tally: Counter[int],
    key: int,
    rules: GlimpseSetRules,
) -> list[GlimpseSets]:
    """Build one set for each of the chosen objects."""
    poses = np.stack([camera_pose(spot, 0.0) for spot in [point, *_sample_neighbours(world, point, key, rules)]])
    shown = world.renderer.panorama(poses)
    color, depth, ids = shown["color"], shown["depth"][0], shown["instance"]
    relative = np.linalg.inv(poses[0]) @ poses[1:]
    imagined = warp(color[:1], depth[None], relative[None])[0] if len(relative) else color[1:]
    panoramas = np.concatenate([color, color[1:], imagined])
    kinds = np.repeat([START, NEAR, PERFECT, WARPED], [1, *[len(relative)] * 3])
    things = _choose_targets(ids[0], labels, tally, rules)
    if not things:
        return []
    here = np.array([ids[0] == thing for thing in things])
    moved = reproject_masks(here, depth, relative, depth.shape)[0] if len(relative) else here[:, None][:, :0]
    sets = []
    for thing, masks in zip(things, moved, strict=True):
        tracked = remove_specks(masks)
        found, frames = extract_glimpses(panoramas, np.concatenate([ids == thing, tracked, tracked]), kinds <= NEAR)
        sets.append(GlimpseSets(found, np.zeros(len(frames), np.int64), kinds[frames], labels[[thing]]))
        tally[int(labels[thing])] += 1
    return sets


def _sample_neighbours(
    world: World, point: NDArray[np.float64], key: int, rules: GlimpseSetRules
) -> NDArray[np.float64]:
    """Sample places that a straight walk leads to."""
    draws = core.uniform(core.fold_key([key, 1]), 2 * 8 * max(1, rules.neighbours)).reshape(-1, 2)
    angles, lengths = 2 * np.pi * draws[:, 0], rules.reach[0] + np.ptp(rules.reach) * draws[:, 1]
    ways = np.stack([np.sin(angles), np.zeros(len(angles)), np.cos(angles)], axis=1) * lengths[:, None]
    middle, ends = point + ways / 2, point + ways
    free = world.navmesh.is_navigable(middle) & world.navmesh.is_navigable(ends)
    return world.ground.put_down(ends[free][: rules.neighbours]).astype(np.float64)


def _choose_targets(
    ids: NDArray[np.uint32], labels: NDArray[np.int64], tally: Counter[int], rules: GlimpseSetRules
) -> list[int]:
    """Return the instances that are large enough as seen from the place, those of rare categories first."""
    rows, columns = ids.shape
    weights = np.cos(np.pi * ((np.arange(rows) + 0.5) / rows - 0.5)) * 2 * np.pi**2 / rows / columns
    sizes = np.bincount(ids.ravel(), np.repeat(weights, columns), len(labels))
    large = np.flatnonzero((sizes >= rules.smallest) & (labels >= 0))
    rank = sorted(large, key=lambda thing: (tally[int(labels[thing])], -sizes[thing]))
    return [int(thing) for thing in rank[: rules.targets]]
