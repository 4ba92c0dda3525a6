# SPDX-License-Identifier: Apache-2.0
"""Training data of the learned labeller and of colour naming: views of scenes with the truth about each pixel."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from typing import Any

import numpy as np
from numpy.typing import NDArray

from wiw._core import core
from wiw.datasets.cameras import camera_pose
from wiw.datasets.worlds import World
from wiw.errors import ArgumentError
from wiw.panorama import PerspectivePlan, distance_to_planar
from wiw.perception.colors import COLORS
from wiw.perception.labelling_network import FOCAL, PIXELS, InputSize, resize_view, sample_cells
from wiw.perception.scene_labels import CATEGORIES, STATES, STRUCTURE, merge_category
from wiw.scenes import is_generated, possible_edits

SIZE = (384, 448)
"""(H, W) of the views as they are cut out of panoramas."""
PANORAMA_SIZE = (576, 1024)
INPUT = InputSize(176, 208, FOCAL)
"""The cells of the views as they are stored."""
STATE_WORDS = {"half drawn": "closed"}
"""States of scenes that are learned under another name. A curtain that is half drawn is on the closed side of one that
is open, so that the network learns to look at how much of the window shows.
"""
COLOR_SAMPLES = 64
"""Pixels stored of an instance in a view, for learning colour names."""
CLOSE = (0.7, 2.2)
"""Minimum and maximum horizontal distance in metres of a close place from the middle of its thing."""
CANDIDATES = 2000
"""Places from which close ones are chosen."""
LEAST_PIXELS = 150
"""Pixels of a view that an instance must fill for its colour to be learned: 8 by 8 centimetres at 1 m."""
HELD_OUT_FIELD = 105.0
"""Field of view in degrees of the views that labellers are evaluated on, the width at which they are used."""
COLORLESS = ("mirror", "picture", "photo", "window", "opening", "")
"""Categories whose pixels do not show the colour that the scene names."""


@dataclass(frozen=True)
class ViewRules:
    """Rules for sampling a scene."""

    places: int = 12
    close: float = 0.5
    """Share of the places that lie close to a thing, whose categories take turns; the others lie anywhere. Small and
    rare things would otherwise be seen seldom, and from afar.
    """
    views: int = 3
    """Views of a place, in directions spread evenly around it."""
    fields: tuple[float, float] = (90.0, 110.0)
    """Minimum and maximum horizontal field of view in degrees."""


@dataclass(frozen=True)
class LabelledViews:
    """N views and what they show, and the colours of the K instances in them."""

    images: NDArray[np.uint8]
    """uint8 [N, PIXELS * h, PIXELS * w, 3] for h x w cells of the network."""
    depth: NDArray[np.float16]
    """float16 [N, h, w]: planar, in metres; 0 where nothing is hit."""
    category: NDArray[np.uint8]
    """uint8 [N, h, w]: index into `CATEGORIES`."""
    state: NDArray[np.uint8]
    """uint8 [N, h, w]: index into `STATES`."""
    hfov_deg: NDArray[np.float32]
    """float32 [N]."""
    pixels: NDArray[np.uint8]
    """uint8 [K, COLOR_SAMPLES, 3]: pixels of one instance each."""
    color: NDArray[np.uint8]
    """uint8 [K]: index into `COLORS`, the instance's colour."""
    colored_category: NDArray[np.uint8]
    """uint8 [K]: index into `CATEGORIES`."""

    def __len__(self) -> int:
        return len(self.images)


FIELDS = tuple(field.name for field in fields(LabelledViews))


def merge_views(parts: Sequence[LabelledViews]) -> LabelledViews:
    """Concatenate the views of several scenes.

    Raises:
        ArgumentError: there is not one view in them.
    """
    if not sum(map(len, parts)):
        raise ArgumentError("expected scenes with walkable floor, got none; choose others (--scenes)")
    return LabelledViews(*(np.concatenate([getattr(part, name) for part in parts]) for name in FIELDS))


def change_states(spec: str, seed: int) -> str | None:
    """Return the spec of an apartment in which about half of what has a state is in another one; None if nothing is.

    A lamp that is always on teaches nothing about those that are off. Other scenes cannot be changed: None.
    """
    if not is_generated(spec) or "?" in spec:
        return None
    key = core.fold_key([seed, 0x4C24, int(spec.rpartition("/")[2])])
    possible: dict[str, list[str]] = {}
    for edit in possible_edits(spec):
        kind, _, change = edit.partition(":")
        if kind == "state":
            possible.setdefault(change.partition("=")[0], []).append(edit)
    draws = core.uniform(key, 2 * len(possible)).reshape(-1, 2)
    chosen = [
        edits[int(which * len(edits))]
        for (chance, which), (_, edits) in zip(draws, sorted(possible.items()), strict=True)
        if chance < 0.5
    ]
    return _add_edits(spec, _keep_compatible(spec, chosen)) if chosen else None


def _keep_compatible(spec: str, edits: Sequence[str]) -> Sequence[str]:
    """Return the edits that an apartment can have together, the first of those that exclude each other.

    Each edit is possible by itself, but two doors may open into the same space.
    """
    if _is_possible(_add_edits(spec, edits)):  # nearly always, and checking takes as long as for one
        return edits
    kept: list[str] = []
    for edit in edits:
        if _is_possible(_add_edits(spec, [*kept, edit])):
            kept.append(edit)
    return kept


def _add_edits(spec: str, edits: Sequence[str]) -> str:
    return f"{spec}?{'&'.join(edits)}"


def _is_possible(spec: str) -> bool:
    """Return whether an apartment can have all edits of its spec together."""
    try:
        possible_edits(spec)
    except ArgumentError:
        return False
    return True


@dataclass(frozen=True)
class InstanceTable:
    """Each instance's labels, by id; row 0 is nothing."""

    category: NDArray[np.uint8]
    state: NDArray[np.uint8]
    color: NDArray[np.int64]
    """-1 where pixels do not show it."""


def read_instances(instances: Sequence[Mapping[str, Any]]) -> InstanceTable:
    """Return the labels of a scene's instances."""
    numbers = {name: i for i, name in enumerate(CATEGORIES)}
    count = len(instances) + 1
    table = InstanceTable(np.zeros(count, np.uint8), np.zeros(count, np.uint8), np.full(count, -1))
    for each in instances:
        name = merge_category(each["category"])
        state = each["attributes"].get("state", "")
        state, color = STATE_WORDS.get(state, state), each["attributes"].get("color", "")
        table.category[each["id"]] = numbers.get(name, 0)
        table.state[each["id"]] = STATES.index(state) if state in STATES else 0
        if color in COLORS and name in numbers and name not in COLORLESS:
            table.color[each["id"]] = COLORS.index(color)
    return table


def record_views(world: World, seed: int, rules: ViewRules = ViewRules()) -> LabelledViews:
    """Record views of a scene from places where an agent can stand; a pure function of (scene, seed, rules)."""
    key = core.fold_key([seed, 0x4C20, int("?" in world.scene.name)])
    points = world.ground.put_down(_sample_places(world, rules, key)).astype(np.float64)
    draws = core.uniform(core.fold_key([key, 1]), len(points) * 2).reshape(-1, 2)
    table = read_instances(world.scene.instances)
    parts = []
    for number, (point, (turn, zoom)) in enumerate(zip(points, draws, strict=True)):
        pose = camera_pose(point, 0.0)[None]
        shown = world.renderer.panorama(pose, PANORAMA_SIZE, outputs=("color", "depth", "instance"))
        hfov_deg = rules.fields[0] + zoom * (rules.fields[1] - rules.fields[0])
        yaws = [float(360 * (turn + i / rules.views)) for i in range(rules.views)]
        plan = PerspectivePlan(PANORAMA_SIZE, SIZE, hfov_deg)
        images = plan(shown["color"][0], yaws)
        distance, ids = (
            plan(shown[name][0][..., None], yaws, interpolation="nearest")[..., 0] for name in ("depth", "instance")
        )
        depth = distance_to_planar(distance, hfov_deg)
        parts.append(_label_views(images, depth, ids, table, hfov_deg, core.fold_key([key, 2, number])))
    if not parts:
        nothing = np.zeros((0, *SIZE), np.uint32)
        return _label_views(
            np.zeros((0, *SIZE, 3), np.uint8), nothing.astype(np.float32), nothing, table, rules.fields[0], 0
        )
    return merge_views(parts)


def _sample_places(world: World, rules: ViewRules, key: int) -> NDArray[np.float32]:
    """Return places where an agent can stand, float32 [N, 3]: anywhere, and close to things."""
    candidates = world.navmesh.sample(CANDIDATES, core.fold_key([key, 3]), world.floor)
    count = round(rules.close * rules.places)
    close = _choose_close_places(candidates, world.scene.instances, count, core.fold_key([key, 4]))
    return np.concatenate([world.navmesh.sample(rules.places - len(close), key, world.floor), candidates[close]])


def _choose_close_places(
    candidates: NDArray[np.float32], instances: Sequence[Mapping[str, Any]], count: int, key: int
) -> NDArray[np.intp]:
    """Return the rows of at most `count` places that lie close to things, whose categories take turns.

    Args:
        candidates: float32 [N, 3].
        instances: as a scene has them.
        count: number of places.
        key: what chance depends on.
    """
    rng = np.random.default_rng(key)
    by_category: dict[str, list[NDArray[np.float64]]] = {}
    for each in instances:
        name = merge_category(each["category"])
        if name in CATEGORIES and name not in ("", *STRUCTURE):
            by_category.setdefault(name, []).append(np.asarray(each["bounds"], np.float64).mean(axis=0))
    chosen: list[int] = []
    names = [name for _ in range(count) for name in rng.permutation(sorted(by_category))]
    for name in names:
        middle = by_category[name][rng.integers(len(by_category[name]))]
        distance = np.hypot(*(candidates - middle)[:, [0, 2]].T)
        near = np.flatnonzero((distance >= CLOSE[0]) & (distance <= CLOSE[1]))
        if len(chosen) < count and len(near):
            chosen.append(int(rng.choice(near)))
    return np.array(chosen, np.intp)


def _label_views(
    images: NDArray[np.uint8],
    depth: NDArray[np.float32],
    ids: NDArray[np.uint32],
    table: InstanceTable,
    hfov_deg: float,
    key: int,
) -> LabelledViews:
    numbers = sample_cells(ids, INPUT)
    resized = np.array([resize_view(image, INPUT) for image in images], np.uint8)
    return LabelledViews(
        resized.reshape(-1, PIXELS * INPUT.height, PIXELS * INPUT.width, 3),
        sample_cells(depth, INPUT).astype(np.float16),
        table.category[numbers],
        table.state[numbers],
        np.full(len(images), hfov_deg, np.float32),
        *_sample_colors(images, ids, table, np.random.default_rng(key)),
    )


def _sample_colors(
    images: NDArray[np.uint8], ids: NDArray[np.uint32], table: InstanceTable, rng: np.random.Generator
) -> tuple[NDArray[np.uint8], NDArray[np.uint8], NDArray[np.uint8]]:
    """Return pixels of each instance that is large enough in a view, its colour and its category."""
    pixels, found = [], []
    for image, numbers in zip(images, ids, strict=True):
        flat, shown = numbers.ravel(), image.reshape(-1, 3)
        order = np.argsort(flat, kind="stable")
        for instance, first, count in zip(*np.unique(flat[order], return_index=True, return_counts=True), strict=True):
            if count >= LEAST_PIXELS and table.color[instance] >= 0:
                pixels.append(shown[order[first + rng.integers(0, count, COLOR_SAMPLES)]])
                found.append(int(instance))
    return (
        np.array(pixels, np.uint8).reshape(-1, COLOR_SAMPLES, 3),
        table.color[found].astype(np.uint8),
        table.category[found],
    )
