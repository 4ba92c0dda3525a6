# SPDX-License-Identifier: Apache-2.0
"""The scene table of a scene that gives nothing but names: categories from these, colours from renders, rooms by
`room_plan`, states and materials from nowhere, and all of it overridden by a file if there is one.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from wiw.datasets.episodes import read_json
from wiw.datasets.fields import text
from wiw.datasets.questions.colors import name_rendered_color
from wiw.datasets.questions.facts import FLAT, HUNG, SMALL, STRUCTURE, UNCLEAR, Room, SceneTable, Thing, make_table
from wiw.datasets.questions.grammar import COLORS, STATES
from wiw.datasets.questions.room_plan import Floor, RoomPlan, list_rooms, plan_rooms, survey_floor
from wiw.datasets.questions.survey import Survey
from wiw.datasets.worlds import World
from wiw.errors import ArgumentError, FileError

NAMES: Mapping[str, str] = {
    "airconditioner": "air conditioner",
    "chandelier": "pendant lamp",
    "cooking bench": "stove",
    "desk portrait": "photo",
    "folding door": "door",
}
"""Other scenes' words, besides `wiw.datasets.ar.ALIASES`."""
FIELDS = ("category", "color", "material", "state", "room")
OFF_FLOOR, LITTLE, EYE_LEVEL = 0.1, 0.5, 0.6
"""Metres: what begins above the first and is smaller than the second stands on something; what begins above the third
may hang on a wall."""
EXPOSURES = (0.85, 1.0, 1.18)
"""Brightness at which a colour must have one name: whether a thing in dim light is white or grey, nobody could say."""
LOOKS = 4
"""Views in which a thing's colour must have one name."""


@dataclass(frozen=True)
class Attributes:
    """Attributes of instances that a file gives, by their names."""

    overlay: tuple[tuple[str, tuple[tuple[str, str], ...]], ...] = ()

    def to_info(self) -> dict[str, dict[str, str]]:
        """Return it as JSON."""
        return {name: dict(fields) for name, fields in self.overlay}

    def of(self, name: str) -> dict[str, str]:
        """Return what is said of an instance."""
        return dict(dict(self.overlay).get(name, ()))


NO_ATTRIBUTES = Attributes()


def read_attributes(path: str | Path) -> Attributes:
    """Read a JSON file of instance names to fields: {"Desk_01": {"color": "brown", "state": "open", "room": "study"}}.

    A room is the kind of one that the scene has. An empty text says that nothing is known.

    Raises:
        FileError: it cannot be read, or is not of this form; names the instance.
    """
    body = read_json(path)
    try:
        if not isinstance(body, Mapping):
            raise ValueError('expected an object such as {"Desk_01": {"color": "brown"}}')
        return Attributes(tuple((str(name), _read_fields(str(name), fields)) for name, fields in body.items()))
    except ValueError as error:
        raise FileError(f"{path}: {error}") from error


def _read_fields(name: str, fields: Any) -> tuple[tuple[str, str], ...]:
    if not isinstance(fields, Mapping) or not set(fields) <= set(FIELDS):
        raise ValueError(f"{name}: expected an object with some of {', '.join(FIELDS)}, got {fields!r:.80}")
    found = {key: text(value, f"{name}: {key}") for key, value in fields.items()}
    for key, allowed in (("color", COLORS), ("state", STATES)):
        if found.get(key) and found[key] not in allowed:
            raise ValueError(f"{name}: {key}: expected one of {', '.join(allowed)}, got '{found[key]}'")
    return tuple(sorted(found.items()))


def observe_table(world: World, survey: Survey, attributes: Attributes, clear: float) -> SceneTable:
    """Return the table of a scene according to its names and renders.

    Args:
        world: the scene.
        survey: views of it.
        attributes: what a file says instead.
        clear: least share of a thing's pixels that have the name of its colour.

    Raises:
        ArgumentError: the file names an instance, or a room, that the scene does not have.
    """
    plain = make_table(world.scene, world.name)
    _require_names(world, plain, attributes)
    things = [_rename(thing, attributes.of(thing.name)) for thing in plain.things]
    floor = survey_floor(world, things, survey.points)
    plan = plan_rooms(floor, things)
    rooms = list_rooms(plan)
    placed = []
    for thing in things:
        said = attributes.of(thing.name)
        room = _read_room(thing.name, said["room"], rooms) if "room" in said else _find_room(thing, plan, floor)
        color = said["color"] if "color" in said else _find_color(world, survey, thing, clear)
        placed.append(replace(thing, room=room, color=color))
    return _sort_by_place(SceneTable(plain.name, tuple(placed), rooms))


def _sort_by_place(table: SceneTable) -> SceneTable:
    """Return the table with what stands on furniture, and what hangs on walls, by where it is.

    Small things off the floor stand on something. What begins at eye level and stands on nothing hangs.
    """
    loose = {thing.category for thing in table.things if _is_loose(thing)}
    fixed = {thing.category for thing in table.things if not _is_loose(thing)}
    sorted_ = replace(table, small=SMALL | (loose - fixed - STRUCTURE - HUNG - FLAT))
    hung = {
        thing.category for thing in sorted_.things if thing.low[1] > EYE_LEVEL and sorted_.find_support(thing) is None
    }
    return replace(sorted_, hung=HUNG | (hung - STRUCTURE - FLAT))


def _is_loose(thing: Thing) -> bool:
    return bool(thing.low[1] > OFF_FLOOR and (thing.high - thing.low < LITTLE).all())


def _read_room(name: str, kind: str, rooms: Sequence[Room]) -> str:
    """Return the name of the only room of a kind that a file gives."""
    if not kind:
        return UNCLEAR
    fit = [room.name for room in rooms if room.kind == kind]
    if len(fit) != 1:
        known = ", ".join(sorted(room.kind for room in rooms)) or "none"
        raise ArgumentError(
            f"attributes: {name}: room: expected a kind that exactly one room of the scene has, of {known}; got "
            f"'{kind}'"
        )
    return fit[0]


def _find_room(thing: Thing, plan: RoomPlan, floor: Floor) -> str:
    if thing.category in STRUCTURE:
        return ""
    number = plan.find_thing(thing.low, thing.high, floor.open)
    return plan.name_room(number) if number else UNCLEAR


def _require_names(world: World, table: SceneTable, attributes: Attributes) -> None:
    unknown = sorted({name for name, _ in attributes.overlay} - {thing.name for thing in table.things})
    if unknown:
        raise ArgumentError(
            f"attributes: {world.name} has no instance '{unknown[0]}'; it has "
            f"{', '.join(thing.name for thing in table.things[:5])}, ..."
        )


def _rename(thing: Thing, said: Mapping[str, str]) -> Thing:
    """Return a thing in the words of questions. Which side of it is its front is not known."""
    category = said.get("category", NAMES.get(thing.category, thing.category))
    material, state = (said.get(name, "") for name in ("material", "state"))
    return replace(thing, category=category, material=material, state=state, color="", front=np.zeros(3))


def _find_color(world: World, survey: Survey, thing: Thing, clear: float) -> str:
    """Return the name that a thing's colour has in all of a few views that show it best; empty without one."""
    if thing.category in STRUCTURE:
        return ""
    shares = survey.shares[:, :, thing.id].max(axis=1)
    best = [int(place) for place in np.argsort(-shares, kind="stable")[:LOOKS] if shares[place] > 0]
    if not best:
        return ""
    yaws = [float(survey.headings[int(survey.shares[place, :, thing.id].argmax())]) for place in best]
    at = [(*(float(value) for value in survey.points[place]), yaw) for place, yaw in zip(best, yaws, strict=True)]
    return name_rendered_color(world, thing.id, at, clear, EXPOSURES)  # type: ignore[arg-type]
