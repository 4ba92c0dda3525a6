# SPDX-License-Identifier: Apache-2.0
"""Training data of the recogniser: objects seen from a place, and from places nearby, really and in imagination."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from wiw._core import core
from wiw.datasets.ar import CATEGORIES, EpisodeRules, category_of, generate
from wiw.datasets.cameras import camera_pose
from wiw.datasets.visibility import COARSE, measure_sizes
from wiw.datasets.worlds import World
from wiw.errors import ArgumentError
from wiw.perception.glimpses import Glimpses, extract_glimpses, join_glimpses
from wiw.perception.tracking import remove_specks, reproject_masks
from wiw.reproject import warp
from wiw.types import Episode

START, NEAR, PERFECT, WARPED = 0, 1, 2, 3
"""Kinds of glimpses: from the place itself; really seen from a place nearby; imagined from there by a perfect world
model; imagined by reprojection. The box of an imagined glimpse is the tracker's.
"""
HARD_LOOKS = EpisodeRules(first_look="balanced", small=0.4)
"""Rules of the first looks of hard sets."""
WAY_SHARES = np.array([0.0, 0.4, 0.7, 1.0])
"""Shares of the way to the best view at which a hard set is looked at."""


@dataclass(frozen=True)
class GlimpseSetRules:
    """Rules for sampling a scene. Lengths in metres."""

    places: int = 8
    targets: int = 5
    """Maximum number of objects observed from a place; those of rare categories come first."""
    neighbours: int = 3
    reach: tuple[float, float] = (0.25, 1.6)
    """Minimum and maximum distance of the neighbours; the second is the length of eight steps."""
    smallest: float = 0.0015
    """Minimum solid angle of a target in steradians, 45 pixels of the panorama."""
    survey: int = 150
    """Number of candidate places."""
    reshape: float = 1.25
    """Greatest factor by which furniture is stretched or shrunk along each of its axes, at every other place anew; 1
    leaves it as it is."""

    def __post_init__(self) -> None:
        if not (np.isfinite(self.reshape) and self.reshape >= 1):
            raise ArgumentError(f"GlimpseSetRules: reshape: expected a factor of 1 or more, got {self.reshape}")


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
    if not sum(len(part) for part in parts):
        raise ArgumentError("expected scenes with objects of the categories, got none; choose others (--scenes)")
    return join_glimpse_sets(parts)


def join_glimpse_sets(parts: Sequence[GlimpseSets]) -> GlimpseSets:
    """Concatenate sets; an empty list gives none."""
    nothing = GlimpseSets(join_glimpses([]), *(np.zeros(0, np.int64) for _ in range(3)))
    parts = [nothing, *parts]
    shifts = np.cumsum([0, *(len(part) for part in parts[:-1])])
    return GlimpseSets(
        join_glimpses([part.glimpses for part in parts]),
        np.concatenate([part.owners + shift for part, shift in zip(parts, shifts, strict=True)]),
        np.concatenate([part.kinds for part in parts]),
        np.concatenate([part.labels for part in parts]),
    )


def split_in_half(data: GlimpseSets) -> tuple[GlimpseSets, GlimpseSets]:
    """Split the sets into a first and a second half. As sets are ordered by scene, the halves show different scenes,
    except for the one in the middle.

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
    points = world.ground.put_down(world.navmesh.sample(rules.survey, key, world.floor)).astype(np.float64)
    sizes = np.where(labels >= 0, measure_sizes(world, points, COARSE), 0.0)
    tally: Counter[int] = Counter()
    parts: list[GlimpseSets] = []
    for number in range(rules.places):
        place = _choose_place(sizes, labels, tally, rules)
        if place is None:
            break
        draw = core.fold_key([key, number])
        with reshape_furniture(world, labels, core.fold_key([draw, 2]), rules.reshape if number % 2 else 1.0):
            parts += _collect_at_place(world, points[place], labels, tally, draw, rules)
        sizes[place] = 0
    return join_glimpse_sets(parts)


@contextmanager
def reshape_furniture(world: World, labels: NDArray[np.int64], key: int, most: float) -> Iterator[None]:
    """Render each labelled instance stretched along its own axes, by random factors from 1 / `most` to `most`.

    The middle of its lower side stays where it is, so that what stands on the floor goes on to.

    Args:
        world: where the furniture stands.
        labels: int64 [1 + instances]: -1 for instances that are left as they are.
        key: of the random factors.
        most: 1 leaves all as it is.
    """
    ids = np.flatnonzero(labels >= 0).astype(np.uint32)
    if most == 1 or not len(ids):
        yield
        return
    things = [world.scene.instances[number - 1] for number in ids]
    homes = np.array([thing["T_world_instance"] for thing in things], np.float64)
    factors = most ** (2 * core.uniform(key, 3 * len(ids)).reshape(-1, 3) - 1)
    bounds = np.array([thing["bounds"] for thing in things], np.float64)
    pivots = bounds.mean(axis=1)
    pivots[:, 1] = bounds[:, 0, 1]
    world.renderer.set_poses(ids, _stretch(homes, factors, pivots))
    try:
        yield
    finally:
        world.renderer.set_poses(ids, homes)


def _stretch(
    T_world_instance: NDArray[np.float64], factors: NDArray[np.float64], pivots: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return affine poses [N, 4, 4] that scale along the instances' axes and keep the pivots [N, 3] (world metres)."""
    axes = T_world_instance[:, :3, :3]
    scaled = T_world_instance.copy()
    scaled[:, :3, :3] = axes * factors[:, None, :]
    inside = np.linalg.solve(axes, (pivots - T_world_instance[:, :3, 3])[..., None])
    scaled[:, :3, 3] = pivots - (scaled[:, :3, :3] @ inside)[..., 0]
    return scaled


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
    points = np.stack([point, *_sample_neighbours(world, point, key, rules)])

    def choose(ids: NDArray[np.uint32]) -> list[int]:
        return _choose_targets(ids, labels, tally, rules)

    parts = _build_sets(world, points, choose, labels)
    for part in parts:
        tally[int(part.labels[0])] += 1
    return parts


def collect_hard_sets(
    world: World,
    seed: int,
    categories: Sequence[str] = CATEGORIES,
    count: int = 5,
    rules: EpisodeRules = HARD_LOOKS,
) -> GlimpseSets:
    """Collect glimpses whose first look is hard, the others from the way to the best view, as episodes have them.

    Args:
        world: where the objects are.
        seed: of the episodes, which are generated for this purpose.
        categories: what objects are.
        count: sets; fewer in a scene that does not offer as many.
        rules: of first and best looks.
    """
    numbers = {name: i for i, name in enumerate(categories)}
    labels = np.array([-1, *(numbers.get(category_of(thing), -1) for thing in world.scene.instances)])
    parts: list[GlimpseSets] = []
    for episode in _generate_episodes(world, count, seed, categories, rules):
        start, end = np.asarray(episode.start_position), np.asarray(episode.info["best_position"])
        points = world.ground.put_down(start + WAY_SHARES[:, None] * (end - start)).astype(np.float64)
        target = int(episode.info["target"])
        parts += _build_sets(world, points, lambda ids, target=target: [target], labels)  # type: ignore[misc]
    return join_glimpse_sets(parts)


def _generate_episodes(
    world: World, count: int, seed: int, categories: Sequence[str], rules: EpisodeRules
) -> list[Episode]:
    """Return as many episodes as a scene offers, at most `count`."""
    for fewer in range(count, 0, -1):
        try:
            return generate(world, fewer, seed, categories, rules)
        except ArgumentError:
            continue
    return []


def _build_sets(
    world: World,
    points: NDArray[np.float64],
    choose: Callable[[NDArray[np.uint32]], list[int]],
    labels: NDArray[np.int64],
) -> list[GlimpseSets]:
    """Build a set for each object that `choose` picks among the ids seen from the first point, uint32 [H, W]."""
    poses = np.stack([camera_pose(spot, 0.0) for spot in points])
    shown = world.renderer.panorama(poses)
    color, depth, ids = shown["color"], shown["depth"], shown["instance"]
    things = choose(ids[0])
    if not things:
        return []
    relative = np.linalg.inv(poses[0]) @ poses[1:]
    imagined = warp(color[:1], depth[:1], relative[None])[0] if len(relative) else color[1:]
    panoramas = np.concatenate([color, color[1:], imagined])
    kinds = np.repeat([START, NEAR, PERFECT, WARPED], [1, *[len(relative)] * 3])
    depths = [*depth, *[None] * (2 * len(relative))]
    here = np.array([ids[0] == thing for thing in things])
    moved = reproject_masks(here, depth[0], relative, depth.shape[1:])[0] if len(relative) else here[:, None][:, :0]
    sets = []
    for thing, masks in zip(things, moved, strict=True):
        tracked = remove_specks(masks)
        followed = np.concatenate([ids == thing, tracked, tracked])
        found, frames = extract_glimpses(panoramas, followed, kinds <= NEAR, depths)
        if not len(frames) or frames[0]:  # nothing of it is in the panorama, which has coarser pixels than the survey
            continue
        sets.append(GlimpseSets(found, np.zeros(len(frames), np.int64), kinds[frames], labels[[thing]]))
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
