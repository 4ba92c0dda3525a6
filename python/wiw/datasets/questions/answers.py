# SPDX-License-Identifier: Apache-2.0
"""The true answer of a template with its words in one scene table, and the things that must be in view to know it."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass

from wiw.datasets.questions.facts import BROADER, FRONTED, HUNG, STRUCTURE, UNCLEAR, Room, SceneTable, Thing
from wiw.datasets.questions.grammar import ACTIVITIES, CAPACITIES, HABITS, TEMPLATES, USES

Slots = Mapping[str, str]

MATERIALS = {"wood planks": "wood", "wood parquet": "wood", "textile": "fabric", "enamel": "metal", "plant": ""}
"""Words for materials that a table distinguishes and nobody else does; "" is not an answer."""
ON_STATES, OPEN_STATES = ("on", "off"), ("open", "closed")
COUNTED = (
    "chair",
    "picture",
    "plant",
    "window",
    "bottle",
    "cup",
    "bookshelf",
    "nightstand",
    "mirror",
    "armchair",
    "stool",
)
"""Categories that `count_in` counts."""
LOOKED_FOR = (
    "armchair",
    "bathtub",
    "bin",
    "bookshelf",
    "desk",
    "dining table",
    "dresser",
    "floor lamp",
    "laundry basket",
    "microwave",
    "mirror",
    "piano",
    "pouf",
    "rug",
    "shower",
    "side table",
    "sideboard",
    "television",
    "wardrobe",
    "washing machine",
)
"""Categories whose existence is requested."""
PLURAL = frozenset({"books", "candles", "kitchen utensils"})
"""Categories whose names are plurals: nothing is asked about what "the books" are like."""
PATTERNED = frozenset({"books", "mirror", "picture", "window"})
"""Categories that have no one colour or material to see."""
ROOM_SIGNS = {"bedroom": "bed", "bathroom": "toilet"}
"""Rooms that are counted, and what shows that a room is one."""
MOST_STOPS = 4
"""Places that a walk which counts things all over a home may lead to."""
_NEIGHBOURS = {
    "white": ("grey", "beige"),
    "black": ("grey", "brown"),
    "beige": ("grey", "yellow", "brown", "pink"),
    "brown": ("orange", "red"),
    "red": ("pink", "orange"),
    "yellow": ("orange", "green"),
    "turquoise": ("green", "blue"),
    "purple": ("blue", "pink"),
}
CONFUSABLE = frozenset(frozenset((name, other)) for name, others in _NEIGHBOURS.items() for other in others)
"""Colours that may be taken for each other."""


@dataclass(frozen=True)
class Sight:
    """Instances that must all be in view at one place, from within a room where one is named."""

    things: tuple[int, ...]
    room: str = ""
    around: bool = False
    """Whether they may be in view in different directions, and be small, as when things in a room are counted."""


@dataclass(frozen=True)
class Fact:
    """The true answer in one scene."""

    answer: str
    sights: tuple[Sight, ...]
    """All needed to know the answer, in any order."""
    target: tuple[int, ...]
    extra_answers: tuple[str, ...] = ()
    colored: int = 0
    """Id of the instance whose colour the question speaks of, and which must be rendered in it; 0 without."""
    color: str = ""
    """Name of that colour."""
    gist: str = ""
    """The part of the answer by which answers are distinguished; the room of a place."""

    @property
    def key(self) -> str:
        """The part in which two answers must differ to count as different."""
        return self.gist or self.answer


def are_different(first: Fact, second: Fact, answer_type: str) -> bool:
    """Return whether two answers to one question are so different that none is a good guess at the other."""
    if answer_type == "color" and frozenset((first.answer, second.answer)) in CONFUSABLE:
        return False
    return first.key != second.key


def resemblance(guess: str, fact: Fact, answer_type: str) -> float:
    """Return about how close a guess is, from 0 to 1 for the right answer."""
    if guess == fact.answer:
        return 1.0
    if answer_type == "place":
        return 0.5 * (guess.rpartition("in the ")[2] == fact.key.rpartition("in the ")[2])
    if answer_type == "color":
        return 0.5 * (frozenset((guess, fact.answer)) in CONFUSABLE)
    if answer_type == "count" and guess.isdecimal():
        return 0.25 * (abs(int(guess) - int(fact.answer)) == 1)
    return 0.0


def find_answer(table: SceneTable, template: str, slots: Slots) -> Fact | None:
    """Return what is true of a question in a scene, or None if it has no answer, or more than one."""
    if "room" in slots and (table.find_room(slots["room"]) is None or _may_be_elsewhere(table, slots)):
        return None
    fact = _ANSWERS[template](table, slots)
    return None if fact is None or any(sight.room == UNCLEAR for sight in fact.sights) else fact


def _may_be_elsewhere(table: SceneTable, slots: Slots) -> bool:
    """Return whether something that a question speaks of may be in its room or not: nobody could say."""
    words = {*slots.values(), *USES.get(slots.get("use", ""), ())}
    return any(
        thing.room == UNCLEAR and {thing.category, BROADER.get(thing.category)} & words for thing in table.things
    )


def propose(table: SceneTable) -> Iterator[tuple[str, dict[str, str]]]:
    """Yield every template with words that may have an answer in a scene, in a fixed order, some more than once."""
    categories = sorted({thing.category for thing in table.things} - STRUCTURE - PLURAL)
    for template in ("color", "material", "switch", "opening", "where", "which_room"):
        for category in categories:
            for room in _rooms(table, category) if "room" in TEMPLATES[template].slots else [{}]:
                yield template, {"object": category, **room}
    yield from _propose_states(table)
    yield from _propose_anchored(table)
    yield from _propose_rooms(table)
    for thing in table.things:
        if thing.category not in STRUCTURE | PLURAL and thing.color:
            yield "where_colored", {"color": thing.color, "object": thing.category}
    for activity in ACTIVITIES:
        yield "activity", {"activity": activity}
    for habit in HABITS:
        yield "habit", {"habit": habit}
    for rooms in ROOM_SIGNS:
        yield "count_rooms", {"rooms": rooms}
    for capacity in CAPACITIES:
        yield "capacity", {"capacity": capacity}
    yield "sleepers", {}


def _rooms(table: SceneTable, category: str) -> list[dict[str, str]]:
    """Return the room slots with which a category may be named: none, or each room that has it and is alone in kind."""
    kinds = {table.kind_of(thing.room) for thing in table.find_all(category)}
    return [{}] + [{"room": kind} for kind in sorted(kinds) if table.find_room(kind) is not None]


def _propose_states(table: SceneTable) -> Iterator[tuple[str, dict[str, str]]]:
    for category in sorted({thing.category for thing in table.things if thing.state} - PLURAL - STRUCTURE):
        for room in _rooms(table, category):
            for state in (*ON_STATES, *OPEN_STATES):
                yield "is_state", {"object": category, "state": state, **room}


def _propose_anchored(table: SceneTable) -> Iterator[tuple[str, dict[str, str]]]:
    pieces = table.furniture() + [thing for thing in table.things if thing.category == "wall shelf"]
    for category in sorted({thing.category for thing in pieces}):
        for room in _rooms(table, category):
            yield "on_top", {"anchor": category, **room}
            yield "count_on", {"anchor": category, **room}
            yield "above", {"anchor": category, **room}
            if category in FRONTED:
                yield "beside", {"side": "left", "anchor": category, **room}
                yield "beside", {"side": "right", "anchor": category, **room}
            if category == "dining table":
                yield "count_around", {"objects": "chair", "anchor": category, **room}
                yield "seats", {"anchor": category, **room}


def _propose_rooms(table: SceneTable) -> Iterator[tuple[str, dict[str, str]]]:
    for kind in sorted(table.room_kinds):
        room = table.find_room(kind)
        if room is None:
            continue
        for template in ("floor_color", "wall_color", "floor_material"):
            yield template, {"room": kind}
        for category in COUNTED:
            yield "count_in", {"objects": category, "room": kind}
        for category in LOOKED_FOR:
            yield "exists", {"object": category, "room": kind}
        for use in USES:
            yield "use", {"use": use, "room": kind}
        pieces = sorted({piece.category for piece in table.furniture(room.name)})
        for thing in pieces:
            others = [each for each in pieces if each != thing]
            for i, first in enumerate(others):
                for second in others[i + 1 :]:
                    yield "nearer", {"object": thing, "room": kind, "first": first, "second": second}


# -- answers by template -----------------------------------------------------------------------------------------------


def _find_slot_room(table: SceneTable, slots: Slots) -> Room | None:
    return table.find_room(slots["room"]) if "room" in slots else None


def _find_named(table: SceneTable, slots: Slots, slot: str = "object") -> Thing | None:
    return table.find_one(slots[slot], _find_slot_room(table, slots))


def _make_sight(thing: Thing, *others: Thing) -> tuple[Sight, ...]:
    return (Sight((thing.id, *(other.id for other in others))),)


def _find_representative(found: list[Thing]) -> Thing | None:
    """Return the thing that stands for all of them: there is one, or they are of one category."""
    return found[0] if found and len({thing.category for thing in found}) == 1 else None


def _answer_by_relation(table: SceneTable, slots: Slots, find: Callable[[Thing], list[Thing]]) -> Fact | None:
    anchor = _find_named(table, slots, "anchor")
    found = find(anchor) if anchor is not None else []
    thing = _find_representative(found)
    if anchor is None or thing is None:
        return None
    return Fact(thing.category, _make_sight(found[0], anchor), tuple(each.id for each in found))


def _answer_on_top(table: SceneTable, slots: Slots) -> Fact | None:
    return _answer_by_relation(table, slots, table.things_on)


def _answer_above(table: SceneTable, slots: Slots) -> Fact | None:
    return _answer_by_relation(table, slots, table.things_above)


def _answer_beside(table: SceneTable, slots: Slots) -> Fact | None:
    def find(anchor: Thing) -> list[Thing]:
        if anchor.category not in FRONTED:
            return []
        near = table.things_beside(anchor, slots["side"])
        # A second one not much farther away would be as good an answer.
        return near[:1] if len(near) == 1 else []

    return _answer_by_relation(table, slots, find)


def _answer_color(table: SceneTable, slots: Slots) -> Fact | None:
    return _color_of(_find_named(table, slots))


def _color_of(thing: Thing | None) -> Fact | None:
    if thing is None or not thing.color or thing.category in PATTERNED:
        return None
    return Fact(thing.color, _make_sight(thing), (thing.id,), colored=thing.id, color=thing.color)


def _answer_floor_color(table: SceneTable, slots: Slots) -> Fact | None:
    room = table.find_room(slots["room"])
    return _color_of(table.structure("floor", room)) if room else None


def _answer_wall_color(table: SceneTable, slots: Slots) -> Fact | None:
    room = table.find_room(slots["room"])
    return _color_of(table.structure("wall", room)) if room else None


def _material_of(thing: Thing | None) -> Fact | None:
    word = MATERIALS.get(thing.material, thing.material) if thing is not None else ""
    if thing is None or not word or thing.category in PATTERNED:
        return None
    extra = ("painted wood",) if word == "lacquer" else ()
    return Fact(word, _make_sight(thing), (thing.id,), extra)


def _answer_material(table: SceneTable, slots: Slots) -> Fact | None:
    return _material_of(_find_named(table, slots))


def _answer_floor_material(table: SceneTable, slots: Slots) -> Fact | None:
    room = table.find_room(slots["room"])
    return _material_of(table.structure("floor", room)) if room else None


def _answer_state(table: SceneTable, slots: Slots, states: tuple[str, str]) -> Fact | None:
    thing = _find_named(table, slots)
    return Fact(thing.state, _make_sight(thing), (thing.id,)) if thing is not None and thing.state in states else None


def _answer_on_or_off(table: SceneTable, slots: Slots) -> Fact | None:
    return _answer_state(table, slots, ON_STATES)


def _answer_open_or_closed(table: SceneTable, slots: Slots) -> Fact | None:
    return _answer_state(table, slots, OPEN_STATES)


def _answer_is_state(table: SceneTable, slots: Slots) -> Fact | None:
    states = ON_STATES if slots["state"] in ON_STATES else OPEN_STATES
    fact = _answer_state(table, slots, states)
    if fact is None:
        return None
    return Fact("yes" if fact.answer == slots["state"] else "no", fact.sights, fact.target)


def _answer_place(table: SceneTable, thing: Thing) -> Fact | None:
    """Return where a thing is: on or next to an anchor, in a room."""
    kind = table.kind_of(thing.room)
    if not kind:
        return None
    support = table.find_support(thing)
    anchor = support or table.nearest_furniture(thing)
    if anchor is None:
        return Fact(f"in the {kind}", _make_sight(thing), (thing.id,), gist=kind)
    relation = "on" if support else "next to"
    answer = f"{relation} the {anchor.category} in the {kind}"
    extra = (f"above the {anchor.category} in the {kind}",) if thing.category in HUNG and not support else ()
    return Fact(answer, _make_sight(thing), (thing.id,), extra, gist=kind)


def _answer_where(table: SceneTable, slots: Slots) -> Fact | None:
    thing = table.find_one(slots["object"])
    return _answer_place(table, thing) if thing is not None else None


def _answer_where_colored(table: SceneTable, slots: Slots) -> Fact | None:
    category, color = slots["object"], slots["color"]
    all_of_it = table.find_all(category)
    alike = [each for each in all_of_it if each.color == color or frozenset((each.color, color)) in CONFUSABLE]
    if len(alike) != 1 or len(all_of_it) < 2 or alike[0].category != category or alike[0].color != color:
        return None
    if category in PATTERNED:
        return None
    fact = _answer_place(table, alike[0])
    if fact is None:
        return None
    return Fact(fact.answer, fact.sights, fact.target, fact.extra_answers, alike[0].id, color, fact.gist)


def _answer_which_room(table: SceneTable, slots: Slots) -> Fact | None:
    return _room_of(table, table.find_all(slots["object"]), exactly=True, category=slots["object"])


def _room_of(table: SceneTable, found: list[Thing], exactly: bool = False, category: str = "") -> Fact | None:
    """Return the room that all of some things are in."""
    kinds = {thing.room for thing in found}
    if len(kinds) != 1 or (exactly and len(found) != 1) or (category and found[0].category != category):
        return None
    kind = table.kind_of(found[0].room)
    return Fact(kind, _make_sight(found[0]), tuple(thing.id for thing in found)) if kind else None


def _find_sights_in_room(room: Room, found: list[Thing], table: SceneTable) -> tuple[Sight, ...] | None:
    """Return what shows that these are all there is in a room: a place in it with all of them in view."""
    floor = table.structure("floor", room)
    if floor is None:
        return None
    return (Sight(tuple(thing.id for thing in found) or (floor.id,), room.name, around=True),)


def _answer_count_in_room(table: SceneTable, slots: Slots) -> Fact | None:
    room = table.find_room(slots["room"])
    found = table.find_all(slots["objects"], room) if room else []
    sights = _find_sights_in_room(room, found, table) if room and found else None
    return Fact(str(len(found)), sights, tuple(thing.id for thing in found)) if sights else None


def _answer_exists(table: SceneTable, slots: Slots) -> Fact | None:
    room = table.find_room(slots["room"])
    found = table.find_all(slots["object"], room) if room else []
    sights = _find_sights_in_room(room, found[:1], table) if room else None
    return Fact("yes" if found else "no", sights, tuple(thing.id for thing in found)) if sights else None


def _answer_count_around(table: SceneTable, slots: Slots) -> Fact | None:
    anchor = _find_named(table, slots, "anchor")
    if anchor is None or slots["objects"] not in ("chair",):
        return None
    near, wide = (table.things_around(slots["objects"], anchor, reach) for reach in (0.6, 1.0))
    if not near or len(near) != len(wide):  # one a little farther off may be counted or not
        return None
    ids = tuple(thing.id for thing in near)
    return Fact(str(len(near)), (Sight((anchor.id, *ids), anchor.room, around=True),), (anchor.id, *ids))


def _answer_count_on(table: SceneTable, slots: Slots) -> Fact | None:
    anchor = _find_named(table, slots, "anchor")
    found = table.things_on(anchor) if anchor is not None else []
    if anchor is None or not found or anchor.category in ("bookshelf",):
        return None
    ids = tuple(thing.id for thing in found)
    return Fact(str(len(found)), (Sight((anchor.id, *ids), anchor.room, around=True),), (anchor.id, *ids))


def _answer_nearer(table: SceneTable, slots: Slots) -> Fact | None:
    room = _find_slot_room(table, slots)
    things = [table.find_one(slots[name], room) for name in ("object", "first", "second")]
    if len({slots[name] for name in ("object", "first", "second")}) < 3:
        return None
    thing, first, second = things
    if thing is None or first is None or second is None or not thing.room == first.room == second.room:
        return None
    to_first, to_second = thing.distance(first), thing.distance(second)
    if max(to_first, to_second) < 2 * min(to_first, to_second) + 0.5:
        return None
    nearer = first if to_first < to_second else second
    sight = Sight((thing.id, first.id, second.id), thing.room, around=True)
    return Fact(nearer.category, (sight,), (thing.id, first.id, second.id))


def _answer_activity(table: SceneTable, slots: Slots) -> Fact | None:
    found = [thing for word in ACTIVITIES[slots["activity"]] for thing in table.find_all(word)]
    if not found or len({thing.room for thing in found}) != 1:
        return None
    kind, thing = table.kind_of(found[0].room), found[0]
    if not kind:
        return None
    extra = (f"next to the {thing.category} in the {kind}",)
    ids = tuple(each.id for each in found)
    return Fact(f"at the {thing.category} in the {kind}", _make_sight(thing), ids, extra, gist=kind)


def _answer_use(table: SceneTable, slots: Slots) -> Fact | None:
    room = table.find_room(slots["room"])
    found = [thing for word in USES[slots["use"]] for thing in table.find_all(word, room)] if room else []
    thing = _find_representative(found)
    if room is None or thing is None:
        return None
    return Fact(thing.category, (Sight((thing.id,), room.name),), tuple(dict.fromkeys(each.id for each in found)))


def _answer_count_rooms(table: SceneTable, slots: Slots) -> Fact | None:
    rooms = [room for room in table.rooms if room.kind == slots["rooms"]]
    if (
        slots["rooms"] not in ROOM_SIGNS
        or not rooms
        or (slots["rooms"] == "bedroom" and table.room_kinds.get("kids room"))
    ):
        return None  # a kids room is a bedroom to some and not to others
    signs = [next(iter(table.find_all(ROOM_SIGNS[slots["rooms"]], room)), None) for room in rooms]
    if any(sign is None for sign in signs):
        return None
    ids = tuple(sign.id for sign in signs if sign is not None)
    return Fact(str(len(rooms)), tuple(Sight((each,)) for each in ids), ids)


def _answer_sleeping_places(table: SceneTable, slots: Slots) -> Fact | None:
    beds = table.find_all("bed")
    if not 0 < len(beds) <= MOST_STOPS or any(
        1.15 < _measure_width(bed) < 1.4 for bed in beds
    ):  # wide for one and narrow for two
        return None
    count = sum(2 if bed.category == "bunk bed" or _measure_width(bed) >= 1.4 else 1 for bed in beds)
    ids = tuple(bed.id for bed in beds)
    return Fact(str(count), tuple(Sight((each,)) for each in ids), ids)


def _answer_capacity(table: SceneTable, slots: Slots) -> Fact | None:
    found = table.find_all(CAPACITIES[slots["capacity"]])
    if not 0 < len(found) <= MOST_STOPS:
        return None
    ids = tuple(thing.id for thing in found)
    return Fact(str(len(found)), tuple(Sight((each,)) for each in ids), ids)


def _measure_width(bed: Thing) -> float:
    return float(sorted((bed.high - bed.low)[[0, 2]])[0])


def _answer_habit(table: SceneTable, slots: Slots) -> Fact | None:
    return _room_of(table, [thing for word in HABITS[slots["habit"]] for thing in table.find_all(word)])


_ANSWERS: Mapping[str, Callable[[SceneTable, Slots], Fact | None]] = {
    "on_top": _answer_on_top,
    "above": _answer_above,
    "beside": _answer_beside,
    "floor_color": _answer_floor_color,
    "wall_color": _answer_wall_color,
    "color": _answer_color,
    "floor_material": _answer_floor_material,
    "material": _answer_material,
    "switch": _answer_on_or_off,
    "opening": _answer_open_or_closed,
    "is_state": _answer_is_state,
    "where": _answer_where,
    "where_colored": _answer_where_colored,
    "which_room": _answer_which_room,
    "count_in": _answer_count_in_room,
    "count_around": _answer_count_around,
    "count_on": _answer_count_on,
    "exists": _answer_exists,
    "nearer": _answer_nearer,
    "activity": _answer_activity,
    "use": _answer_use,
    "count_rooms": _answer_count_rooms,
    "sleepers": _answer_sleeping_places,
    "capacity": _answer_capacity,
    "seats": lambda table, slots: _answer_count_around(table, {**slots, "objects": "chair"}),
    "habit": _answer_habit,
}
