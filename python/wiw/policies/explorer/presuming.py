# SPDX-License-Identifier: Apache-2.0
"""Presuppositions of a question: that what it speaks of is there, once, and in the room it names.

A map has a thing twice, or two rooms that might be the kitchen; the question knows better. It does not reveal the
answer.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from wiw.datasets.questions import ParsedQuestion
from wiw.datasets.questions.answers import Fact, find_answer
from wiw.datasets.questions.facts import SMALL, STRUCTURE, Room, SceneTable
from wiw.policies.explorer.home import Home

NAMED = ("object", "anchor", "first", "second")
"""Slots of things of which there is one, in most templates."""
SEVERAL = frozenset({"exists", "where_colored"})
"""Templates whose object may be there more than once, or not at all."""
ON_ANCHOR = frozenset({"on_top", "count_on"})
"""Templates that take for granted that something stands on their anchor."""
MOST_LEVELS = 16
"""Levels of support at most that are tried."""
LEAST_KIND = 0.02
"""Probability from which on a room may be of a kind that a question names."""


def find_likeliest(home: Home, question: ParsedQuestion) -> Fact | None:
    """Return the best supported answer to a question: what hinders one is left out, the weakest first."""
    homes = [home]
    if home.scraps:
        homes.append(replace(home, table=replace(home.table, things=home.table.things + home.scraps)))
    for believed in homes:
        for table in _drop_weak_things(believed, question, assume_named_things(believed, question)):
            fact = find_answer(table, question.template, question.slots)
            if fact is not None:
                return fact
    return None


def assume_named_things(home: Home, question: ParsedQuestion) -> SceneTable:
    """Return the table of a home with one room of the kind that a question names, and one of each thing it names."""
    table = home.table
    kind = question.slots.get("room")
    room = _choose_room(home, kind) if kind is not None else None
    if room is not None:
        table = _name_room(home, table, room, str(kind))
    if question.template not in SEVERAL:
        for name in NAMED:
            if name in question.slots:
                table = _keep_one(home, table, question.slots[name], room)
    return table


def _choose_room(home: Home, kind: str) -> Room | None:
    """Return the room that is most probably of a kind."""
    shares = {room.name: home.room_kinds[room.name].get(kind, 0.0) for room in home.table.rooms}
    best = max(home.table.rooms, key=lambda room: shares[room.name], default=None)
    return best if best is not None and shares[best.name] >= LEAST_KIND else None


def _name_room(home: Home, table: SceneTable, chosen: Room, kind: str) -> SceneTable:
    """Give a room a kind, and others that were taken for it their next likely one."""
    rooms = []
    for room in table.rooms:
        if room.name == chosen.name:
            rooms.append(replace(room, kind=kind))
        elif room.kind == kind:
            others = {name: share for name, share in home.room_kinds[room.name].items() if name != kind}
            rooms.append(replace(room, kind=max(sorted(others), key=lambda name: others[name])))
        else:
            rooms.append(room)
    return replace(table, rooms=tuple(rooms))


def _keep_one(home: Home, table: SceneTable, category: str, room: Room | None) -> SceneTable:
    """Leave out all things that a word may mean but the best supported one, within the room if one is named."""
    there = [thing for thing in table.find_all(category, room) if thing.category == category]
    if not there and room is not None:  # at the room's edge, or through its door
        there = [replace(thing, room=room.name) for thing in table.find_all(category) if not thing.room]
    if not there:
        return table
    best = max(there, key=lambda thing: (home.weigh(thing), -thing.id))
    rivals = {thing.id for thing in table.find_all(category, room)} | {best.id}
    return replace(table, things=(*(thing for thing in table.things if thing.id not in rivals), best))


def _drop_weak_things(home: Home, question: ParsedQuestion, table: SceneTable) -> Iterator[SceneTable]:
    """Yield the table, then without what else things may stand on, then with ever fewer weakly supported things."""
    yield table
    anchor = table.find_one(question.slots.get("anchor", ""))
    if anchor is not None and question.template in ON_ANCHOR:
        rest = (thing for thing in table.things if thing is anchor or thing.category in SMALL | STRUCTURE)
        yield replace(table, things=tuple(rest))
    weights = {thing.id: home.weigh(thing) for thing in table.things}
    levels = sorted({weight for weight in weights.values() if np.isfinite(weight)})
    for least in levels[:: -(-len(levels) // MOST_LEVELS) or 1]:
        yield replace(table, things=tuple(thing for thing in table.things if weights[thing.id] > least))
