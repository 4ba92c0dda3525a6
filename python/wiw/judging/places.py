# SPDX-License-Identifier: Apache-2.0
"""Marks of places: an anchor ("on the coffee table"), a room ("in the living room"), or both."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import IntEnum

from wiw.judging.judge import HIGHEST_MARK, LOWEST_MARK
from wiw.judging.normalise import is_negated
from wiw.judging.vocabulary import Concept, Match, Relation, load_vocabulary
from wiw.judging.words import split_clauses

ANCHOR_MARK, ROOM_MARK, CATEGORY_MARK = 4, 3, 2
BROADER_ROOM_MARK = 4
"""Mark of "bedroom" where "kids room" is all that was requested."""
_SIDES = {
    "under": ("under", "below", "beneath", "underneath"),
    "above": ("above", "over"),
    "on": ("on", "top", "atop", "onto"),
    "left": ("left",),
    "right": ("right",),
    "front": ("front",),
    "behind": ("behind", "back"),
}
_SIDE_OF_WORD = {word: side for side, words in _SIDES.items() for word in words}
_CONTRADICTIONS = {
    frozenset(pair) for pair in (("under", "above"), ("under", "on"), ("left", "right"), ("front", "behind"))
}
_HORIZONTAL = frozenset({"left", "right", "front", "behind"})


class Fit(IntEnum):
    """How well what an answer says of an anchor or a room fits; higher is better."""

    WRONG = 0
    UNSTATED = 1
    CATEGORY = 2
    """Another one of the right category: of another colour or number, or on its other side."""
    BROADER = 3
    RIGHT = 4


@dataclass(frozen=True)
class Part:
    """An anchor or a room as it is mentioned: "left of the red sofa 2"."""

    concept: Concept
    colors: tuple[Concept, ...] = ()
    side: str = ""
    number: str = ""


@dataclass(frozen=True)
class Place:
    """The anchors and rooms that a text mentions."""

    anchors: tuple[Part, ...]
    rooms: tuple[Part, ...]


def names_place(question: str, text: str) -> bool:
    """Return whether a text mentions an anchor or a room."""
    place = read_place(text)
    return bool(place.anchors or place.rooms)


def mark_place(question: str, right: str, answer: str) -> int:
    """Return 5 for anchor and room, 4 for the anchor, 3 for the room, 2 for a wrong anchor of the right category.

    What the question mentions and the right answer does not, such as the thing whose place is requested, is not an
    anchor. Where the right answer has only an anchor or only a room, that alone is worth 5.
    """
    wanted = read_place(right)
    known = {part.concept for part in (*wanted.anchors, *wanted.rooms)}
    asked = read_place(question)
    ignored = {part.concept for part in (*asked.anchors, *asked.rooms)} - known
    said = read_place(answer, ignored)
    anchor, room = _fit_parts(wanted.anchors, said.anchors, 1), _fit_parts(wanted.rooms, said.rooms, 0)
    if not wanted.anchors:
        return {Fit.RIGHT: HIGHEST_MARK, Fit.BROADER: BROADER_ROOM_MARK}.get(room, LOWEST_MARK)
    if anchor >= Fit.BROADER and (not wanted.rooms or room >= Fit.BROADER):
        return HIGHEST_MARK
    if anchor >= Fit.BROADER and room == Fit.UNSTATED:
        return ANCHOR_MARK
    if room >= Fit.BROADER:
        return ROOM_MARK
    return CATEGORY_MARK if anchor >= Fit.CATEGORY else LOWEST_MARK


def read_place(text: str, ignored: set[Concept] | None = None) -> Place:
    """Return the anchors and rooms that a text affirms, without ignored ones."""
    anchors: list[Part] = []
    rooms: list[Part] = []
    for clause in split_clauses(text):
        end = 0
        for match in load_vocabulary().find(clause, ["object", "room"]):
            if not is_negated(clause, match) and match.concept not in (ignored or ()):
                part = _read_part(clause, end, match)
                (rooms if match.concept.kind == "room" else anchors).append(part)
            end = match.end
    return Place(tuple(anchors), tuple(rooms))


def _read_part(clause: Sequence[str], begin: int, match: Match) -> Part:
    before = clause[begin : match.start]
    colors = tuple(found.concept for found in load_vocabulary().find(before, ["color"]))
    sides = [_SIDE_OF_WORD[word] for word in before if word in _SIDE_OF_WORD]
    side = next((each for each in sides if each in _HORIZONTAL), sides[-1] if sides else "")  # "on the left of"
    after = clause[match.end : match.end + 1]
    return Part(match.concept, colors, side, after[0] if after and after[0].isdigit() else "")


def _fit_parts(wanted: Sequence[Part], said: Sequence[Part], spare: int) -> Fit:
    """Return how well mentions fit: the best of them, but less where too many are wrong, as in a list of rooms.

    Args:
        wanted: mentions of the right answer.
        said: mentions of the answer.
        spare: number of wrong mentions that are allowed beside as many right ones; a room has no second one.
    """
    if not said:
        return Fit.UNSTATED
    fits = [max((_fit_part(part, other) for part in wanted), default=Fit.WRONG) for other in said]
    right = sum(fit >= Fit.BROADER for fit in fits)
    best = max(fits)
    return best if best < Fit.BROADER or len(fits) - right < right + spare else Fit.CATEGORY


def _fit_part(wanted: Part, said: Part) -> Fit:
    relation = load_vocabulary().find_relation(wanted.concept, said.concept)
    if relation >= Relation.BROADER:
        if _contradict(wanted, said):
            return Fit.CATEGORY
        return Fit.RIGHT if relation == Relation.SAME else Fit.BROADER
    return Fit.CATEGORY if relation == Relation.GROUP else Fit.WRONG


def _contradict(one: Part, other: Part) -> bool:
    """Return whether two mentions are of different things or of opposite sides of one."""
    find_relation = load_vocabulary().find_relation
    colors = one.colors and other.colors and not any(find_relation(a, b) for a in one.colors for b in other.colors)
    numbers = one.number and other.number and one.number != other.number
    return bool(colors or numbers or frozenset((one.side, other.side)) in _CONTRADICTIONS)
