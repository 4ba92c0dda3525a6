# SPDX-License-Identifier: Apache-2.0
"""The scene table: what stands where in a scene, of what colour, material and state, and how things relate.

Relations are measured on axis-aligned bounds in metres, Y up. The words follow `wiw.datasets.ar.ALIASES`.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from wiw.datasets.ar import category_of
from wiw.scenes import Scene

STRUCTURE = frozenset({"floor", "ceiling", "wall", "passage", "opening", "door frame", "door", "window"})
"""Categories that are the building's and not in it."""
SMALL = frozenset(
    {
        *("table lamp", "laptop", "microwave", "kettle", "bowl", "vase", "plant pot"),
        *("photo", "box", "candles", "books", "bottle", "cup", "television"),
    }
)
"""Categories that stand on furniture."""
HUNG = frozenset({"picture", "mirror", "clock", "wall shelf"})
"""Categories that hang on walls at eye level."""
FLAT = frozenset({"rug", "curtain", "radiator", "ceiling lamp", "pendant lamp"})
"""Categories that nothing stands on or next to."""
FRONTED = frozenset(
    {
        *("sofa", "bed", "desk", "wardrobe", "dresser", "bookshelf", "sink", "kitchen sink", "toilet", "stove"),
        *("refrigerator", "tv stand", "sideboard", "washing machine", "piano", "console table"),
    }
)
"""Categories with a front, so that they have a left and a right."""
BROADER = {
    "bunk bed": "bed",
    "kitchen cabinet": "cabinet",
    "kitchen counter": "counter",
    "kitchen sink": "sink",
    "office chair": "chair",
    "plant pot": "plant",
    "toy box": "box",
}
"""Categories that a shorter word may mean as well: "the chair" is no one thing beside an office chair."""
PASSAGES = {"hall": "hallway", "corridor": "hallway"}
"""Rooms that nobody would distinguish by name."""


UNCLEAR = "?"
"""Room of a thing of which nobody could say which room it is in."""


@dataclass(frozen=True, eq=False)
class Room:
    """A room with its inner bounds."""

    name: str
    kind: str
    """Such as "bedroom"; several rooms may be of one kind."""
    low: NDArray[np.float64]
    high: NDArray[np.float64]

    def contains(self, points: NDArray[np.float64]) -> NDArray[np.bool_]:
        """Return whether places [N, 3] lie within the walls."""
        across = points[:, [0, 2]]
        inside = (across >= self.low[[0, 2]]) & (across <= self.high[[0, 2]])
        return np.logical_and(inside[:, 0], inside[:, 1])


@dataclass(frozen=True, eq=False)
class Thing:
    """An instance of a scene."""

    id: int
    name: str
    category: str
    color: str
    material: str
    state: str
    room: str
    """Name of its room; empty outside of any, `UNCLEAR` between several."""
    low: NDArray[np.float64]
    high: NDArray[np.float64]
    front: NDArray[np.float64]
    """Unit vector, horizontal."""

    @property
    def centre(self) -> NDArray[np.float64]:
        """Middle of the bounds."""
        return (self.low + self.high) / 2

    def distance(self, other: Thing) -> float:
        """Return the horizontal gap between the bounds of two things, 0 where one is over the other."""
        gap = np.maximum(0.0, np.maximum(self.low - other.high, other.low - self.high))
        return float(np.hypot(gap[0], gap[2]))


@dataclass(frozen=True, eq=False)
class SceneTable:
    """Things and rooms of a scene."""

    name: str
    things: tuple[Thing, ...]
    rooms: tuple[Room, ...]
    small: frozenset[str] = SMALL
    """Categories that stand on furniture here."""
    hung: frozenset[str] = HUNG
    """Categories that hang on walls here."""

    @property
    def room_kinds(self) -> dict[str, list[Room]]:
        """Rooms by kind."""
        kinds: dict[str, list[Room]] = {}
        for room in self.rooms:
            kinds.setdefault(room.kind, []).append(room)
        return kinds

    def find_room(self, kind: str) -> Room | None:
        """Return the only room of a kind; None if there is none, or more than one."""
        rooms = self.room_kinds.get(kind, [])
        return rooms[0] if len(rooms) == 1 else None

    def kind_of(self, room: str) -> str:
        """Return the kind of a room by its name."""
        return next((each.kind for each in self.rooms if each.name == room), "")

    def find_all(self, category: str, room: Room | None = None) -> list[Thing]:
        """Return what a word may mean, in a room or anywhere: things of the category or of a narrower one."""
        return [
            thing
            for thing in self.things
            if category in (thing.category, BROADER.get(thing.category)) and (room is None or thing.room == room.name)
        ]

    def find_one(self, category: str, room: Room | None = None) -> Thing | None:
        """Return the only thing that a word can mean, if there is one."""
        found = self.find_all(category, room)
        return found[0] if len(found) == 1 and found[0].category == category else None

    def structure(self, category: str, room: Room) -> Thing | None:
        """Return the floor or the walls of a room."""
        found = [thing for thing in self.things if thing.category == category and thing.room == room.name]
        return found[0] if len(found) == 1 else None

    def furniture(self, room: str | None = None) -> list[Thing]:
        """Return what stands on the floor, in a room or anywhere."""
        return [
            thing
            for thing in self.things
            if thing.category not in STRUCTURE | self.small | self.hung | FLAT
            and thing.low[1] < 0.35
            and (room is None or thing.room == room)
        ]

    def find_support(self, thing: Thing) -> Thing | None:
        """Return what a small thing stands on or in."""
        if thing.category not in self.small:
            return None
        under = [
            other
            for other in self.things
            if other.id != thing.id
            and other.category not in STRUCTURE | FLAT | self.small
            and other.room == thing.room
            and _is_over(thing, other)
            and other.low[1] - 0.03 <= thing.low[1] <= other.high[1] + 0.05
        ]
        return min(under, key=lambda other: (abs(thing.low[1] - other.high[1]), other.id), default=None)

    def things_on(self, anchor: Thing) -> list[Thing]:
        """Return the small things on a piece of furniture."""
        return [
            thing
            for thing in self.things
            if thing.category in self.small and thing.room == anchor.room and self.find_support(thing) is anchor
        ]

    def things_above(self, anchor: Thing) -> list[Thing]:
        """Return what hangs on the wall right above a piece of furniture."""
        return [
            thing
            for thing in self.things
            if thing.category in self.hung
            and thing.room == anchor.room
            and thing.low[1] >= anchor.high[1] - 0.25
            and thing.centre[1] > anchor.centre[1]
            and _is_over(thing, anchor, 0.25)
        ]

    def things_beside(self, anchor: Thing, side: str, reach: float = 0.7) -> list[Thing]:
        """Return furniture to one side of an anchor, as seen by someone who faces it, nearest first."""
        right = np.array([anchor.front[2], 0.0, -anchor.front[0]])  # of one who looks along -front
        across = right if side == "right" else -right
        found = []
        for thing in self.furniture(anchor.room):
            if thing is anchor:
                continue
            gap = _find_lowest(thing, across) - _find_highest(anchor, across)
            overlap = min(_find_highest(thing, anchor.front), _find_highest(anchor, anchor.front)) - max(
                _find_lowest(thing, anchor.front), _find_lowest(anchor, anchor.front)
            )
            if -0.15 <= gap <= reach and overlap > 0.1:
                found.append((gap, thing.id, thing))
        return [thing for *_, thing in sorted(found)]

    def things_around(self, category: str, anchor: Thing, reach: float = 0.6) -> list[Thing]:
        """Return the things of a category within reach of an anchor."""
        return [
            thing for thing in self.find_all(category) if thing.room == anchor.room and thing.distance(anchor) <= reach
        ]

    def nearest_furniture(self, thing: Thing, reach: float = 1.2) -> Thing | None:
        """Return the furniture nearest to a thing in its room, of which the room has one; None if out of reach."""
        pieces = [other for other in self.furniture(thing.room) if other.id != thing.id]
        counts = {piece.category: sum(piece.category == other.category for other in pieces) for piece in pieces}
        near = [
            (thing.distance(piece), piece.id, piece)
            for piece in pieces
            if counts[piece.category] == 1 and piece.category != thing.category and thing.distance(piece) <= reach
        ]
        return min(near)[2] if near else None


def make_table(scene: Scene, name: str = "") -> SceneTable:
    """Return the table of a scene, which has no rooms where the scene does not define them.

    Instances of a scan that have no surface are left out.
    """
    rooms = tuple(
        Room(room["name"], PASSAGES.get(room["type"], room["type"]), *np.asarray(room["bounds"], np.float64))
        for room in scene.rooms
    )
    things = tuple(_build_thing(instance) for instance in scene.instances if instance["triangle_count"])
    return SceneTable(name or scene.name, things, rooms)


def _build_thing(instance: dict[str, object]) -> Thing:
    attributes = instance["attributes"]
    assert isinstance(attributes, dict)
    low, high = np.asarray(instance["bounds"], np.float64)
    front = np.asarray(instance["T_world_instance"], np.float64)[:3, 2] * [1.0, 0.0, 1.0]
    return Thing(
        id=int(str(instance["id"])),
        name=str(instance["name"]),
        category=category_of(instance),
        color=attributes.get("color", ""),
        material=attributes.get("material", ""),
        state=attributes.get("state", ""),
        room=attributes.get("room", ""),
        low=low,
        high=high,
        front=front / max(1e-9, float(np.linalg.norm(front))),
    )


def _is_over(thing: Thing, other: Thing, margin: float = 0.03) -> bool:
    """Return whether the middle of a thing is above, below or within another's footprint."""
    middle, axes = thing.centre, [0, 2]
    return bool((middle[axes] >= other.low[axes] - margin).all() and (middle[axes] <= other.high[axes] + margin).all())


def _list_corners(thing: Thing) -> NDArray[np.float64]:
    xs, zs = (thing.low[0], thing.high[0]), (thing.low[2], thing.high[2])
    return np.array([[x, 0.0, z] for x in xs for z in zs])


def _find_lowest(thing: Thing, axis: NDArray[np.float64]) -> float:
    return float((_list_corners(thing) @ axis).min())


def _find_highest(thing: Thing, axis: NDArray[np.float64]) -> float:
    return float((_list_corners(thing) @ axis).max())
