# SPDX-License-Identifier: Apache-2.0
"""A home as an agent believes it to be: its map of objects as a scene table, with rooms named by what is in them."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from wiw.datasets.questions.facts import FRONTED, Room, SceneTable, Thing
from wiw.mapping.object_map import MapObject, ObjectMap
from wiw.mapping.occupancy import OccupancyGrid

KNOWLEDGE = Path(__file__).with_name("knowledge.json")
"""Statistics of homes, counted in train apartments by `wiw.training.home_knowledge`."""
SMOOTHING = 0.02
"""Added to each mean, so that nothing is impossible."""
UNSEEN = 0.1
"""Weight of each thing that a room of a kind usually has and that was not observed."""
LEAST_SIZE = 0.0004
"""Share of a view that a thing must once have filled to be believed in."""
LEAST_SHARE = 0.4
"""Share of its votes that a thing's category must have."""


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

    @property
    def kinds(self) -> tuple[str, ...]:
        """Kinds of rooms, sorted."""
        return tuple(sorted(self.rooms))

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
    """By id of the table's things; floors and walls have none."""
    room_names: Mapping[int, str]
    """By number of the grid's rooms."""
    room_shares: Mapping[str, float]
    """Probability of the kind that each room is taken for, by the room's name."""


def believe_home(objects: ObjectMap, grid: OccupancyGrid, surfaces: Sequence[Surface], knowledge: Knowledge) -> Home:
    """Return the home that a map of it shows."""
    seen = [thing for thing in objects.objects if thing.size >= LEAST_SIZE and thing.category_share >= LEAST_SHARE]
    places = {thing.id: grid.find_room(thing.points) for thing in seen}
    rooms, names, shares = _name_rooms(seen, places, grid, knowledge)
    things = [_make_thing(thing, names.get(places[thing.id], ""), grid, knowledge) for thing in seen]
    things += _make_surfaces(surfaces, grid, names, knowledge, first=max(places, default=0) + 1)
    return Home(SceneTable("", tuple(things), tuple(rooms)), {thing.id: thing for thing in seen}, names, shares)


def to_table_frame(points: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return points (x forward, y left, z up) in the axes of scene tables, which have Y up and look down -Z."""
    return np.asarray(np.stack([-points[..., 1], points[..., 2], -points[..., 0]], axis=-1))


def _name_rooms(
    seen: Sequence[MapObject], places: Mapping[int, int], grid: OccupancyGrid, knowledge: Knowledge
) -> tuple[list[Room], dict[int, str], dict[str, float]]:
    rooms, names, shares = [], dict[int, str](), dict[str, float]()
    for number in range(1, int(grid.rooms.max(initial=0)) + 1):
        counts: dict[str, int] = {}
        for thing in seen:
            if places[thing.id] == number:
                counts[thing.category] = counts.get(thing.category, 0) + 1
        probabilities = knowledge.judge_room(counts)
        kind = knowledge.kinds[int(probabilities.argmax())]
        name = f"{kind} {number}"
        names[number], shares[name] = name, float(probabilities.max())
        cells = grid.to_points(np.argwhere(grid.rooms == number))
        corners = to_table_frame(np.concatenate([cells, np.zeros((len(cells), 1))], axis=1))
        rooms.append(Room(name, kind, corners.min(axis=0), corners.max(axis=0)))
    return rooms, names, shares


def _make_thing(thing: MapObject, room: str, grid: OccupancyGrid, knowledge: Knowledge) -> Thing:
    corners = to_table_frame(thing.bounds)
    return Thing(
        id=thing.id,
        name=f"{thing.category} {thing.id}",
        category=thing.category,
        color=thing.color,
        material=knowledge.materials.get(thing.category, ""),
        state=thing.state,
        room=room,
        low=corners.min(axis=0),
        high=corners.max(axis=0),
        front=_find_front(thing, grid) if thing.category in FRONTED else np.array([0.0, 0.0, 1.0]),
    )


def _find_front(thing: MapObject, grid: OccupancyGrid) -> NDArray[np.float64]:
    """Return the horizontal axis on which the floor beside a thing is most free: furniture stands against walls."""
    low, high = thing.bounds[:, :2]
    middle, half = (low + high) / 2, (high - low) / 2
    best, most = np.array([1.0, 0.0]), -1.0
    for axis in np.array([[1.0, 0.0], [-1.0, 0.0], [0.0, 1.0], [0.0, -1.0]]):
        across = np.array([-axis[1], axis[0]])
        ahead = np.abs(axis) @ half + np.array([0.15, 0.3, 0.45, 0.6])
        beside = np.linspace(-0.8, 0.8, 5) * (np.abs(across) @ half)
        points = middle + ahead[:, None, None] * axis + beside[None, :, None] * across
        free = float(grid.lookup(grid.free, points.reshape(-1, 2)).mean())
        if free > most:
            best, most = axis, free
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
            material = knowledge.materials.get(f"{category}/{color}", knowledge.materials.get(category, ""))
            nowhere = np.zeros(3)
            name = f"{category} of {room}"
            made.append(Thing(first + number, name, category, color, material, "", room, nowhere, nowhere, nowhere))
    return made
