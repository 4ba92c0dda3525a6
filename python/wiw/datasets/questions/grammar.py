# SPDX-License-Identifier: Apache-2.0
"""The language of generated questions: `phrase` makes a text of a template and its words, `parse` finds them again.

An agent may use it: it says what a question is about, never what is true.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache

from wiw.errors import ArgumentError
from wiw.scenes import COLORS

STATES = ("on", "off", "open", "closed")

ACTIVITIES: Mapping[str, tuple[str, ...]] = {
    "wash clothes": ("washing machine",),
    "sit down at a table to eat": ("dining table",),
    "work at a desk": ("desk",),
    "watch television": ("television",),
    "play the piano": ("piano",),
    "hang up a coat": ("coat rack",),
    "put away shoes": ("shoe rack",),
    "throw something away": ("bin",),
    "use a computer": ("laptop",),
    "see what time it is": ("clock",),
    "put dirty laundry": ("laundry basket",),
    "take a bath": ("bathtub",),
    "take a shower": ("shower",),
    "heat up food": ("microwave",),
    "listen to music from a speaker": ("speaker",),
    "find a book to read": ("bookshelf", "books"),
    "find toys": ("toy box",),
    "sit in an armchair": ("armchair",),
    "rest my feet on a pouf": ("pouf",),
    "arrange flowers in a vase": ("vase",),
    "look at a framed photo": ("photo",),
    "light a candle": ("candles",),
    "keep small things in a box": ("box",),
    "read under a floor lamp": ("floor lamp",),
    "sit on a bench": ("bench",),
    "sit on a stool": ("stool",),
    "water a plant": ("plant",),
    "keep clothes in a dresser": ("dresser",),
    "keep dishes in a sideboard": ("sideboard",),
}
"""Activities in a home, and categories that allow them."""

USES: Mapping[str, tuple[str, ...]] = {
    "sit on": ("sofa", "armchair", "chair", "office chair", "stool", "bench", "pouf"),
    "use to store clothes": ("wardrobe", "dresser"),
    "use to store books": ("bookshelf", "wall shelf"),
    "use to wash myself": ("bathtub", "shower"),
    "use as a reading light": ("floor lamp", "table lamp"),
    "use to entertain myself": ("television", "piano", "laptop"),
    "put a cup down on": ("coffee table", "side table", "dining table", "desk", "nightstand", "console table"),
}
"""Uses of things in a room, and categories that serve them."""

HABITS: Mapping[str, tuple[str, ...]] = {
    "have their meals": ("dining table",),
    "do their laundry": ("washing machine",),
    "work at a desk": ("desk",),
    "watch television": ("television",),
    "make music": ("piano",),
    "keep most of their books": ("bookshelf",),
    "leave their shoes": ("shoe rack",),
    "use a laptop": ("laptop",),
    "relax in an armchair": ("armchair",),
    "listen to music from a speaker": ("speaker",),
    "collect their dirty laundry": ("laundry basket",),
    "look at the clock": ("clock",),
}
"""Habits of people at home, and the furniture that gives them away."""

CAPACITIES: Mapping[str, str] = {
    "wash their hands at a sink": "sink",
    "work at a desk": "desk",
    "relax in an armchair": "armchair",
    "read by a floor lamp": "floor lamp",
    "look into a mirror": "mirror",
}
"""Activities for which each of several people needs one thing."""

_RESERVED = "above are around can does home how in is it left many nearer of off on open closed or people right the to"
_TOKEN = rf"(?!(?:{'|'.join(_RESERVED.split())})\b)[a-z0-9]+"
_THING = rf"{_TOKEN}(?:[ -]{_TOKEN})*"


def _one_of(words: Mapping[str, object] | tuple[str, ...]) -> str:
    return "|".join(re.escape(word) for word in sorted(words, key=len, reverse=True))


_SLOTS = {
    "color": _one_of(COLORS),
    "state": _one_of(STATES),
    "side": "left|right",
    "activity": _one_of(ACTIVITIES),
    "use": _one_of(USES),
    "habit": _one_of(HABITS),
    "capacity": _one_of(CAPACITIES),
    "objects": _THING,
    "rooms": _THING,
}
"""Regular expressions of slots; all others are names of things and rooms."""

_PLURALS = ("objects", "rooms")
"""Slots whose word is written in the plural."""


@dataclass(frozen=True)
class Template:
    """One kind of question. Text in brackets is left out where its slot is not filled."""

    name: str
    category: str
    answer_type: str
    pattern: str

    @property
    def slots(self) -> tuple[str, ...]:
        """Names of the slots."""
        return tuple(re.findall(r"{(\w+)}", self.pattern))

    @property
    def required_slots(self) -> frozenset[str]:
        """Names of the slots that must be filled."""
        return frozenset(re.findall(r"{(\w+)}", re.sub(r"\[.*?\]", "", self.pattern)))


def _templates() -> dict[str, Template]:
    rows = (
        ("on_top", "object recognition", "category", "What is on the {anchor}[ in the {room}]?"),
        ("above", "object recognition", "category", "What hangs on the wall above the {anchor}[ in the {room}]?"),
        ("beside", "object recognition", "category", "What stands to the {side} of the {anchor}[ in the {room}]?"),
        ("floor_color", "attribute recognition", "color", "What color is the floor of the {room}?"),
        ("wall_color", "attribute recognition", "color", "What color are the walls of the {room}?"),
        ("color", "attribute recognition", "color", "What color is the {object}[ in the {room}]?"),
        ("floor_material", "attribute recognition", "material", "What is the floor of the {room} made of?"),
        ("material", "attribute recognition", "material", "What is the {object}[ in the {room}] made of?"),
        ("switch", "object state recognition", "state", "Is the {object}[ in the {room}] on or off?"),
        ("opening", "object state recognition", "state", "Is the {object}[ in the {room}] open or closed?"),
        ("is_state", "object state recognition", "yes_no", "Is the {object}[ in the {room}] {state}?"),
        ("where_colored", "object localization", "place", "Where is the {color} {object}?"),
        ("where", "object localization", "place", "Where is the {object}?"),
        ("which_room", "object localization", "place", "In which room is the {object}?"),
        ("count_in", "spatial understanding", "count", "How many {objects} are in the {room}?"),
        (
            "count_around",
            "spatial understanding",
            "count",
            "How many {objects} are around the {anchor}[ in the {room}]?",
        ),
        ("count_on", "spatial understanding", "count", "How many things are on the {anchor}[ in the {room}]?"),
        ("exists", "spatial understanding", "yes_no", "Is there a {object} in the {room}?"),
        (
            "nearer",
            "spatial understanding",
            "category",
            "Is the {object}[ in the {room}] nearer to the {first} or to the {second}?",
        ),
        ("activity", "functional reasoning", "place", "Where can I {activity}?"),
        ("use", "functional reasoning", "category", "What can I {use} in the {room}?"),
        ("count_rooms", "world knowledge", "count", "How many {rooms} does this home have?"),
        ("sleepers", "world knowledge", "count", "How many people can sleep in the beds of this home?"),
        ("seats", "world knowledge", "count", "How many people can be seated at the {anchor}[ in the {room}]?"),
        ("capacity", "world knowledge", "count", "How many people can {capacity} here, each at one of their own?"),
        ("habit", "world knowledge", "place", "In which room do the people who live here {habit}?"),
    )
    return {row[0]: Template(*row) for row in rows}


TEMPLATES: Mapping[str, Template] = _templates()
"""By name, in the order in which `parse` tries them."""


@dataclass(frozen=True)
class ParsedQuestion:
    """Template and words of a question's text."""

    template: str
    slots: Mapping[str, str]
    answer_type: str
    category: str


def phrase(template: str, slots: Mapping[str, str]) -> str:
    """Return the text of a template with its slots filled; the optional ones may be left out.

    Raises:
        ArgumentError: no such template; a slot is missing or unknown; a word that `parse` could not find again.
    """
    if template not in TEMPLATES:
        raise ArgumentError(f"template '{template}': expected one of {', '.join(TEMPLATES)}")
    kind = TEMPLATES[template]
    if not kind.required_slots <= set(slots) <= set(kind.slots):
        raise ArgumentError(f"template '{template}' has the slots {', '.join(kind.slots)}, got {dict(slots)}")
    for name, word in slots.items():
        if re.fullmatch(_SLOTS.get(name, _THING), word) is None or (
            name in _PLURALS and singular(plural(word)) != word
        ):
            raise ArgumentError(
                f"slot {name} of '{template}': '{word}' cannot be distinguished from the words around it"
            )
    words = {name: plural(word) if name in _PLURALS else word for name, word in slots.items()}
    text = re.sub(r"\[(.*?{(\w+)}.*?)\]", lambda part: part[1] if part[2] in words else "", kind.pattern)
    text = text.format(**words)
    text = re.sub(r"\ba (?=[aeiou])", "an ", text)
    found = parse(text)
    if found is None or found.template != template or found.slots != dict(slots):
        raise ArgumentError(
            f"'{text}' is ambiguous: it does not only mean '{template}' with {dict(slots)}; use other words"
        )
    return text


def parse(text: str) -> ParsedQuestion | None:
    """Return template and words of a text, or None if it is not in this language."""
    plain = " ".join(text.lower().split()).rstrip(" ?") + "?"
    for name, template in TEMPLATES.items():
        match = _regex(name).fullmatch(plain)
        if match is not None:
            slots = {
                slot: singular(word) if slot in _PLURALS else word
                for slot, word in match.groupdict().items()
                if word is not None
            }
            return ParsedQuestion(name, slots, template.answer_type, template.category)
    return None


@cache
def _regex(template: str) -> re.Pattern[str]:
    pattern = TEMPLATES[template].pattern.lower()
    pattern = re.escape(pattern).replace(r"\[", "(?:").replace(r"\]", ")?")
    pattern = pattern.replace(r"\ a\ ", r"\ an?\ ")
    return re.compile(re.sub(r"\\{(\w+)\\}", lambda m: f"(?P<{m[1]}>{_SLOTS.get(m[1], _THING)})", pattern))


def plural(word: str) -> str:
    """Return the plural of a name, such as "bookshelves"."""
    if word.endswith("shelf"):
        return word[:-1] + "ves"
    if word.endswith(("s", "x", "ch", "sh")):
        return word + "es"
    if word.endswith("y") and word[-2:-1] not in tuple("aeiou"):
        return word[:-1] + "ies"
    return word + "s"


def singular(word: str) -> str:
    """Return the name whose plural a word is; the word itself where it is none."""
    for end, instead in (
        ("shelves", "shelf"),
        ("ies", "y"),
        ("ches", "ch"),
        ("shes", "sh"),
        ("xes", "x"),
        ("sses", "ss"),
    ):
        if word.endswith(end):
            return word.removesuffix(end) + instead
    return word.removesuffix("s")
