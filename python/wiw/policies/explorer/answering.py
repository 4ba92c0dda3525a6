# SPDX-License-Identifier: Apache-2.0
"""Answering from a map: what the question's language makes of the home as it is believed to be, and how sure that is.

The language (`wiw.datasets.questions`) says what a question means, never what is true in a scene.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from wiw.datasets.questions.answers import Fact
from wiw.datasets.questions.blind import blind_answer
from wiw.datasets.questions.grammar import ACTIVITIES, HABITS, USES, ParsedQuestion
from wiw.mapping.object_map import MapObject
from wiw.mapping.occupancy import OccupancyGrid
from wiw.policies.explorer.home import Home
from wiw.policies.explorer.presuming import find_likeliest

CLEAR_SIZE = 0.01
"""Share of a view from which on a thing is seen as well as needed."""
WHOLE_HOME = frozenset({"count_rooms", "sleepers", "where_colored"})
"""Templates whose answer needs all of the home to be known."""
WHOLE_ROOM = frozenset({"count_in", "exists", "use"})
"""Templates whose answer needs all of a room to be known."""


@dataclass(frozen=True)
class Belief:
    """The answer that an agent would give now."""

    text: str
    confidence: float
    """From 0 to 1; 0 where nothing observed supports the answer."""
    things: tuple[MapObject, ...] = ()
    """Things that the answer rests on, best looked at next to be surer."""


def list_wanted(question: ParsedQuestion | None) -> tuple[str, ...]:
    """Return the categories that an agent looks for to answer a question, what is asked about first."""
    if question is None:
        return ()
    slots = question.slots
    named = [slots[name] for name in ("object", "objects", "anchor", "first", "second") if name in slots]
    for name, table in (("activity", ACTIVITIES), ("use", USES), ("habit", HABITS)):
        named += table.get(slots.get(name, ""), ())
    if question.template == "sleepers":
        named += ["bed", "bunk bed"]
    if question.template == "count_rooms":
        named += ["bed", "toilet"]
    return tuple(dict.fromkeys(named))


def answer(question: ParsedQuestion | None, text: str, home: Home, grid: OccupancyGrid) -> Belief:
    """Return what the map says in answer to a question, or the most frequent answer to such a text."""
    fact = None if question is None else find_likeliest(home, question)
    if question is None or fact is None:
        return Belief(blind_answer(text), 0.0, _locate(home, list_wanted(question)))
    things = [home.objects[number] for number in fact.target if number in home.objects]
    confidence = _measure_confidence(question, fact, things, home, grid)
    return Belief(fact.answer, confidence, tuple(things))


def _locate(home: Home, categories: Sequence[str]) -> tuple[MapObject, ...]:
    """Return the things of some categories."""
    return tuple(thing for thing in home.objects.values() if thing.category in categories)


def _measure_confidence(
    question: ParsedQuestion, fact: Fact, things: Sequence[MapObject], home: Home, grid: OccupancyGrid
) -> float:
    """Return how sure an answer is: from how well its things were seen, and how much of the place is known."""
    sure = min((measure_clarity(thing) for thing in things), default=0.6)
    if question.answer_type == "state":
        sure *= min((thing.state_share for thing in things), default=0.0)
    if question.answer_type == "color" and things:
        sure *= min(thing.color_share for thing in things)
    named = question.slots.get("room")
    if named is not None:
        sure *= max((kinds.get(named, 0.0) for kinds in home.room_kinds.values()), default=0.0)
    if question.template in WHOLE_HOME:
        sure *= _measure_completeness(grid)
    elif question.template in WHOLE_ROOM and named is not None:
        sure *= _measure_completeness(grid, [n for n, name in home.room_names.items() if name.startswith(named)])
    return float(np.clip(sure, 0.0, 1.0))


def measure_clarity(thing: MapObject) -> float:
    """Return how well a thing was seen, 0 to 1."""
    near = min(1.0, (thing.size / CLEAR_SIZE) ** 0.5)
    again = 1.0 if thing.decisions > 1 else 0.9
    return near * thing.category_share * thing.confidence**0.5 * again


def _measure_completeness(grid: OccupancyGrid, rooms: Sequence[int] | None = None) -> float:
    """Return how much of the home, or of some rooms, is known, 0 to 1: the less the longer its frontiers are."""
    open_edges = 0
    for frontier in grid.frontiers:
        if rooms is None or grid.find_room(frontier.position[None]) in rooms:
            open_edges += frontier.cells
    return float(np.exp(-open_edges / 25.0))
