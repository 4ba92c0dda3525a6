# SPDX-License-Identifier: Apache-2.0
"""A home as an agent believes it to be: its map of objects as a scene table, with rooms named by what is in them."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from wiw.datasets.questions.facts import FRONTED, HUNG, SMALL, Room, SceneTable, Thing
from wiw.mapping.fragments import VOXEL, split_along_wall, split_voxels
from wiw.mapping.object_map import MapObject, ObjectMap
from wiw.mapping.occupancy import OccupancyGrid

KNOWLEDGE = Path(__file__).with_name("knowledge.json")
"""Statistics of homes, counted in train apartments by `wiw.training.home_knowledge`."""
SMOOTHING = 0.02
"""Added to each mean, so that nothing is impossible."""
UNSEEN = 0.1
"""Weight of each thing that a room of a kind usually has and that was not observed."""
LEAST_SIZE = 0.0008
"""Share of a view that a thing must once have filled to be believed in."""
LEAST_SHARE = 0.4
"""Share of its votes that a thing's category must have."""
LEAST_SUPPORT, LEAST_THIN_SUPPORT = 0.3, 0.1
"""Share of the votes of all views for what is there, background included, that a thing's category must have."""
LEAST_VOXEL_SHARE, LEAST_THIN_VOXEL_SHARE = 0.7, 0.35
"""The same of a single voxel for being part of the thing."""
THIN = SMALL | HUNG - {"wall shelf"} | {"rug"}
"""Categories whose voxels are partly those of what they stand on or hang on; less will do for them."""
LEAST_KEPT = 0.1
"""Share of a thing's voxels that must be left."""

LEAST_SURFACE, LEAST_SMALL_SURFACE = 0.12, 0.2
"""Share of its category's usual surface that must be seen of a thing, and of one in `SMALL`."""

WORKTOPS = frozenset({"kitchen counter", "kitchen cabinet"})
"""Categories that stand against walls and have no left and right."""
WALL_REACH = 0.7
"""Metres behind what was seen of furniture in which its wall is looked for."""
TOO_LONG = 1.3
"""Times the usual length of its category, from which on a thing of the map may be several."""
APART = 0.1
"""Metres between two things of the map up to which they may be parts of one."""
ONE_SIZE = (1.1, 0.1)
"""Times the usual sides of its category, and metres added, that such parts fill together at most."""


@dataclass(frozen=True)
class Surface:
    """A look at a floor or a wall: where it is and of what colour."""

    category: str
    position: NDArray[np.float64]
    """float64 [2] in the frame of the start."""
    color: str
    weight: float


@dataclass(frozen=True)
class Knowledge:
    """Statistics of homes."""

    rooms: Mapping[str, float]
    """Share of homes' rooms that are of each kind."""
    contents: Mapping[str, Mapping[str, float]]
    """By kind of room, then by category: how many a room has on average."""
    materials: Mapping[str, str]
    """By category, the most common material."""
    sizes: Mapping[str, Sequence[float]]
    """By category, the medians of the longer and the shorter horizontal side and of the height in metres."""

    @property
    def kinds(self) -> tuple[str, ...]:
        """Kinds of rooms, sorted."""
        return tuple(sorted(self.rooms))

    def name_material(self, category: str, color: str) -> str:
        """Return the most common material of a category, of things in a colour where homes have some."""
        return self.materials.get(f"{category}/{color}", self.materials.get(category, ""))

    def measure_surface(self, category: str) -> float:
        """Return the usual surface of a category, as far as views show it: its top and two of its sides, in m^2."""
        longer, shorter, height = self.sizes.get(category, (0.0, 0.0, 0.0))
        return longer * shorter + (longer + shorter) * height

    def judge_room(self, counts: Mapping[str, int]) -> NDArray[np.float64]:
        """Return the probability of each kind for a room with these things in it (naive Bayes, Poisson counts)."""
        names = sorted({name for kind in self.contents.values() for name in kind})
        means = np.array([[self.contents[kind].get(name, 0.0) for name in names] for kind in self.kinds]) + SMOOTHING
        found = np.array([counts.get(name, 0) for name in names])
        # What is not observed says little: the room may not have been looked at as a whole.
        log = np.log([self.rooms[kind] for kind in self.kinds]) + np.log(means) @ np.minimum(found, 3)
        log -= UNSEEN * means.sum(axis=1)
        shares = np.exp(log - log.max())
        return np.asarray(shares / shares.sum())

    def measure_affinity(self, kind: str, categories: Sequence[str]) -> float:
        """Return how likely a room of a kind has one of some categories in it, 0 to 1."""
        mean = sum(self.contents.get(kind, {}).get(name, 0.0) for name in categories)
        return float(1 - np.exp(-mean))


@cache
def load_knowledge() -> Knowledge:
    """Return the knowledge that the package ships."""
    return Knowledge(**json.loads(KNOWLEDGE.read_text(encoding="utf-8")))


@dataclass(frozen=True)
class Home:
    """The table of what an agent believes, with the objects of its map behind it."""

    table: SceneTable
    objects: Mapping[int, MapObject]
    """By id of the table's things and of the scraps; floors and walls have none."""
    room_names: Mapping[int, str]
    """By number of the grid's rooms."""
    room_kinds: Mapping[str, Mapping[str, float]]
    """Probability of each kind, by the room's name."""
    scraps: tuple[Thing, ...] = ()
    """Parts of things and edges of others, of which too little was seen for the table. `objects` has them."""

    def weigh(self, thing: Thing) -> float:
        """Return the evidence for a thing of the table: how large it was seen, and how surely as what it is."""
        seen = self.objects.get(thing.id)
        return seen.size * seen.category_share * seen.confidence if seen is not None else np.inf


def believe_home(objects: ObjectMap, grid: OccupancyGrid, surfaces: Sequence[Surface], knowledge: Knowledge) -> Home:
    """Return the home that a map of it shows."""
    known = [
        thing
        for thing in objects.objects
        if thing.size >= LEAST_SIZE
        and thing.category_share >= LEAST_SHARE
        and objects.measure_support(thing) >= (LEAST_THIN_SUPPORT if thing.category in THIN else LEAST_SUPPORT)
    ]
    seen = _take_apart(_put_together(_drop_strays(known, objects), objects, knowledge), objects, knowledge)
    places = {thing.id: grid.find_room(thing.points) for thing in seen}
    whole = {thing.id for thing in seen if _is_whole(thing, knowledge)}
    rooms, names, kinds = _name_rooms([thing for thing in seen if thing.id in whole], places, grid, knowledge)
    made = [_make_thing(thing, names.get(places[thing.id], ""), grid, knowledge) for thing in seen]
    things = [thing for thing in made if thing.id in whole]
    things += _make_surfaces(surfaces, grid, names, knowledge, first=max(places, default=0) + 1)
    scraps = tuple(thing for thing in made if thing.id not in whole)
    return Home(SceneTable("", tuple(things), tuple(rooms)), {thing.id: thing for thing in seen}, names, kinds, scraps)


def to_table_frame(points: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return points (x forward, y left, z up) in the axes of scene tables, which have Y up and look down -Z."""
    return np.asarray(np.stack([-points[..., 1], points[..., 2], -points[..., 0]], axis=-1))


def _is_whole(thing: MapObject, knowledge: Knowledge) -> bool:
    """Return whether enough of a thing was seen to be one of its category; the edges of others are taken for scraps."""
    least = LEAST_SMALL_SURFACE if thing.category in SMALL else LEAST_SURFACE
    return len(thing.voxels) * VOXEL**2 >= least * knowledge.measure_surface(thing.category)


def _drop_strays(things: Sequence[MapObject], objects: ObjectMap) -> list[MapObject]:
    """Return the things without the voxels that views mostly saw as something else, where enough of them is left."""
    found = []
    for thing in things:
        least = LEAST_THIN_VOXEL_SHARE if thing.category in THIN else LEAST_VOXEL_SHARE
        voxels = objects.find_supported(thing, least)
        if len(voxels) >= max(1, LEAST_KEPT * len(thing.voxels)):
            found.append(replace(thing, voxels=voxels))
    return found


def _put_together(things: Sequence[MapObject], objects: ObjectMap, knowledge: Knowledge) -> list[MapObject]:
    """Return the things by id, those of one category that touch and are together no larger than one united.

    Of a large thing near ones only see parts. Small things stay as they are: they stand close together.
    """
    found = list[MapObject]()
    for thing in sorted(things, key=lambda thing: (-len(thing.voxels), thing.id)):
        for place, other in enumerate(found):
            if other.category == thing.category and _may_be_one(thing, other, knowledge):
                first, second = sorted((thing, other), key=lambda part: part.id)
                found[place] = objects.unite(first, second)
                break
        else:
            found.append(thing)
    return sorted(found, key=lambda thing: thing.id)


def _may_be_one(thing: MapObject, other: MapObject, knowledge: Knowledge) -> bool:
    """Whether two things of one category touch, and fit together into the usual size of one."""
    usual = knowledge.sizes.get(thing.category)
    if usual is None or thing.category in SMALL:
        return False
    if (np.maximum(other.box[0] - thing.box[1], thing.box[0] - other.box[1]) > APART).any():
        return False
    low, high = np.minimum(thing.bounds[0], other.bounds[0]), np.maximum(thing.bounds[1], other.bounds[1])
    factor, more = ONE_SIZE
    return bool((np.sort((high - low)[:2])[::-1] <= factor * np.array(usual[:2]) + more).all())


def _take_apart(things: Sequence[MapObject], objects: ObjectMap, knowledge: Knowledge) -> list[MapObject]:
    """Return the things, those that are several as several, with new ids.

    Chairs around a table are one fragment in a view across it, and one thing of the map from then on; so are pictures
    side by side. The former do not hang together and are too long for one; the latter have wall between them.
    """
    found, unused = list[MapObject](), max((thing.id for thing in things), default=0) + 1
    for thing in things:
        length = float(np.ptp(thing.points[:, :2], axis=0).max())
        parts = [thing.voxels]
        if thing.category in HUNG:
            category = objects.categories.index(thing.category)
            parts = split_along_wall(thing.voxels, objects.votes.measure_shares(thing.voxels, category))
        elif length > TOO_LONG * knowledge.sizes.get(thing.category, (np.inf,))[0]:
            parts = split_voxels(thing.voxels, bridged=thing.category not in SMALL)
        found.append(replace(thing, voxels=parts[0]))
        for part in parts[1:]:
            found.append(replace(thing, id=unused, voxels=part))
            unused += 1
    return found


def _name_rooms(
    seen: Sequence[MapObject], places: Mapping[int, int], grid: OccupancyGrid, knowledge: Knowledge
) -> tuple[list[Room], dict[int, str], dict[str, dict[str, float]]]:
    rooms, names, kinds = [], dict[int, str](), dict[str, dict[str, float]]()
    for number in range(1, int(grid.rooms.max(initial=0)) + 1):
        counts: dict[str, int] = {}
        for thing in seen:
            if places[thing.id] == number:
                counts[thing.category] = counts.get(thing.category, 0) + 1
        probabilities = knowledge.judge_room(counts)
        kind = knowledge.kinds[int(probabilities.argmax())]
        name = f"{kind} {number}"
        names[number], kinds[name] = name, dict(zip(knowledge.kinds, probabilities.tolist(), strict=True))
        cells = grid.to_points(np.argwhere(grid.rooms == number))
        corners = to_table_frame(np.concatenate([cells, np.zeros((len(cells), 1))], axis=1))
        rooms.append(Room(name, kind, corners.min(axis=0), corners.max(axis=0)))
    return rooms, names, kinds


def _make_thing(thing: MapObject, room: str, grid: OccupancyGrid, knowledge: Knowledge) -> Thing:
    corners = to_table_frame(thing.bounds)
    low, high, front = corners.min(axis=0), corners.max(axis=0), np.array([0.0, 0.0, 1.0])
    if thing.category in FRONTED | WORKTOPS:
        front = _find_front(thing, grid)
        low, high = _complete_bounds(low, high, front, knowledge.sizes.get(thing.category, (0.0, 0.0))[1])
    return Thing(
        id=thing.id,
        name=f"{thing.category} {thing.id}",
        category=thing.category,
        color=thing.color,
        material=knowledge.name_material(thing.category, thing.color),
        state=thing.state,
        room=room,
        low=low,
        high=high,
        front=front,
    )


def _complete_bounds(
    low: NDArray[np.float64], high: NDArray[np.float64], front: NDArray[np.float64], depth: float
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return bounds at least `depth` metres deep: of a worktop at eye level little but the front is in sight."""
    axis = int(np.abs(front).argmax())
    missing = np.zeros(3)
    missing[axis] = max(0.0, depth - float(high[axis] - low[axis]))
    return (low - missing, high) if front[axis] > 0 else (low, high + missing)


def _find_front(thing: MapObject, grid: OccupancyGrid) -> NDArray[np.float64]:
    """Return the horizontal axis, in the table's frame, that a thing faces along: floor ahead, a wall behind, wide."""
    best, most = np.array([1.0, 0.0]), -np.inf
    for axis in np.array([[1.0, 0.0], [-1.0, 0.0], [0.0, 1.0], [0.0, -1.0]]):
        across = np.array([-axis[1], axis[0]])
        along, beside = np.sort(thing.points[:, :2] @ axis), np.sort(thing.points[:, :2] @ across)
        last = len(along) - 1
        width = np.linspace(beside[int(0.1 * last)], beside[int(0.9 * last)], 5)

        def look(layer: NDArray[np.bool_], places: NDArray[np.float64]) -> NDArray[np.bool_]:
            points = places[:, None, None] * axis + width[None, :, None] * across  # noqa: B023 - used at once
            return grid.lookup(layer, points.reshape(-1, 2)).reshape(len(places), -1)

        free = look(grid.free, along[int(0.98 * last)] + np.array([0.15, 0.3, 0.45, 0.6])).mean()
        wall = look(grid.walls, along[int(0.02 * last)] - np.arange(0.0, WALL_REACH, 0.05)).any(axis=0).mean()
        score = free + wall + 0.25 * (np.ptp(along) <= np.ptp(beside))
        if score > most:
            best, most = axis, score
    return to_table_frame(np.array([best[0], best[1], 0.0]))


def _make_surfaces(
    surfaces: Sequence[Surface], grid: OccupancyGrid, names: Mapping[int, str], knowledge: Knowledge, first: int
) -> list[Thing]:
    """Return the floor and the walls of each room, of the colour that most looks at them had."""
    votes: dict[tuple[str, str], dict[str, float]] = {}
    places = grid.list_rooms(np.array([look.position for look in surfaces]).reshape(-1, 2))
    for look, place in zip(surfaces, places.tolist(), strict=True):
        room = names.get(place, "")
        colors = votes.setdefault((look.category, room), {})
        colors[look.color] = colors.get(look.color, 0.0) + look.weight
    made = []
    for number, ((category, room), colors) in enumerate(sorted(votes.items())):
        if room:
            color = max(sorted(colors), key=lambda name: colors[name])
            nowhere = np.zeros(3)
            name = f"{category} of {room}"
            material = knowledge.name_material(category, color)
            made.append(Thing(first + number, name, category, color, material, "", room, nowhere, nowhere, nowhere))
    return made
