# SPDX-License-Identifier: Apache-2.0
"""JSON answers: extracted from a model's text, repaired where only the syntax is wrong, and validated by a schema."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from typing import TYPE_CHECKING, Any, NamedTuple

from wiw.vlm.messages import Completion, Kind, Problem

if TYPE_CHECKING:
    from pydantic import BaseModel

MAX_CHARACTERS = 1 << 16
"""Longer answers are rejected unread."""
KEPT_CHARACTERS = 500
"""Characters of an unusable answer that are recorded."""
REFUSED = ("refusal", "content_filter")
"""Ends of an answer that the model or its server withheld."""
_SYNTAX = re.compile(r"""\\["'\\/bfnrt]|[\s"'`,:;\[\]{}\u2018\u2019\u201c\u201d]""")
_REFUSALS = ("i'm sorry", "i am sorry", "i can't", "i cannot", "sorry,", "i'm unable", "i am unable", "as an ai")


class ParsedObject(NamedTuple):
    """An object that was found in a completion."""

    value: Any
    """Validated by the schema."""
    repaired: bool
    """Whether its syntax was repaired."""
    adapted: bool
    """Whether the schema's model read it in another form than it was written in: keys, case, numbers as text."""


def make_problem(kind: Kind, detail: str, completion: Completion) -> Problem:
    """Describe why a completion cannot be used."""
    return Problem(kind, detail, completion.text[:KEPT_CHARACTERS])


def find_problem(completion: Completion) -> Problem | None:
    """Return what makes a completion unusable for any request; None if it may be parsed."""
    if completion.finish == "huge" or len(completion.text) > MAX_CHARACTERS:
        return make_problem("huge", f"more than {MAX_CHARACTERS} characters", completion)
    if completion.finish in REFUSED:
        return make_problem("refusal", f"the model refused ({completion.finish})", completion)
    if not completion.text.strip():
        return make_problem("empty", "no text", completion)
    return None


def parse_object(completion: Completion, schema: type[BaseModel]) -> ParsedObject | Problem:
    """Return the object in a completion and how it was read, or why there is none.

    Of several objects, the last that fits the schema is the answer; what a model thinks aloud before it does not count.
    """
    found = find_problem(completion)
    if found is not None:
        return found
    found_objects = list(iterate_json_objects(strip_thoughts(completion.text)))
    if not found_objects:
        refused = completion.text.strip().lower().replace("\u2019", "'").startswith(_REFUSALS)
        kind: Kind = "refusal" if refused else "malformed"
        return make_problem(kind, "no JSON object", completion)
    problem: Problem | None = None
    for text, whole in reversed(found_objects):  # what comes before the answer may be a draft, or an example
        read = _read_object(text, whole, completion, schema)
        if not isinstance(read, Problem):
            return read
        problem = problem or read
        if not whole:  # a draft must not stand for an answer that was cut off
            break
    assert problem is not None
    return problem


def _read_object(text: str, whole: bool, completion: Completion, schema: type[BaseModel]) -> ParsedObject | Problem:
    from pydantic import ValidationError

    if not whole:
        return make_problem("truncated", f"the JSON object does not end (finish: {completion.finish})", completion)
    try:
        values, repaired = _load_json(text)
        value = schema.model_validate(values)
        return ParsedObject(value, repaired, value.model_dump(mode="json") != values)
    except ValidationError as error:
        first = error.errors(include_url=False, include_input=False)[0]
        place = ".".join(str(part) for part in first["loc"]) or "the object"
        return make_problem("schema", f"{place}: {first['msg']}", completion)
    except (ValueError, RecursionError) as error:
        return make_problem("malformed", str(error)[:200] or type(error).__name__, completion)


def strip_thoughts(text: str) -> str:
    """Return what follows a model's thoughts, `<think>...</think>`; nothing where they do not end."""
    return text.rpartition("</think>")[2].partition("<think>")[0]


def iterate_json_objects(text: str) -> Iterator[tuple[str, bool]]:
    """Yield each {...} in a text that is not part of another one, and whether it is complete."""
    place = text.find("{")
    while place >= 0:
        found, whole = _read_braces(text, place)
        yield found, whole
        place = text.find("{", place + len(found))


def _read_braces(text: str, begin: int) -> tuple[str, bool]:
    """Return the {...} that begins at a place, and whether it is complete; braces in strings do not count."""
    depth, quoted, place = 0, "", begin
    while place < len(text):
        character = text[place]
        if quoted:
            if character == "\\":
                place += 1
            elif character == quoted:
                quoted = ""
        elif character == '"':
            quoted = character
        elif character in "{[":
            depth += 1
        elif character in "}]":
            depth -= 1
            if depth == 0:
                return text[begin : place + 1], True
        place += 1
    return text[begin:], False


def _load_json(text: str) -> tuple[Any, bool]:
    """Parse the object; report whether its syntax was repaired: quotes, commas and the like, never its content.

    Raises ValueError where that is impossible.
    """
    try:
        return json.loads(text), False
    except ValueError as error:
        from json_repair import repair_json

        mended = repair_json(text, return_objects=True)
        if not isinstance(mended, dict) or _strip_syntax(text) != _strip_syntax("".join(_iterate_leaves(mended))):
            raise error
        return mended, True


def _strip_syntax(text: str) -> str:
    """Return a text without JSON's syntax."""
    return _SYNTAX.sub("", text)


def _iterate_leaves(value: Any) -> Iterator[str]:
    """Yield keys and values in order, as text."""
    if isinstance(value, dict):
        for name, inner in value.items():
            yield str(name)
            yield from _iterate_leaves(inner)
    elif isinstance(value, list):
        for inner in value:
            yield from _iterate_leaves(inner)
    else:
        yield value if isinstance(value, str) else json.dumps(value)
