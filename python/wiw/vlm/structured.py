# SPDX-License-Identifier: Apache-2.0
"""JSON answers: found in what a model wrote, mended where only the syntax slipped, and held to a schema."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

from wiw.vlm.base import Completion, Kind, Problem

if TYPE_CHECKING:
    from pydantic import BaseModel

MOST = 1 << 16
"""Characters of an answer; longer ones are not looked into."""
RAW = 500
"""Characters of an unusable answer that are kept."""
REFUSED = ("refusal", "content_filter")
"""Ends of an answer that the model or its server withheld."""
_SYNTAX = re.compile(r"""\\["'\\/bfnrt]|[\s"'`,:;\[\]{}\u2018\u2019\u201c\u201d]""")
_REFUSALS = ("i'm sorry", "i am sorry", "i can't", "i cannot", "sorry,", "i'm unable", "i am unable", "as an ai")


def problem(kind: Kind, detail: str, completion: Completion) -> Problem:
    """Why a completion cannot be used."""
    return Problem(kind, detail, completion.text[:RAW])


def unfit(completion: Completion) -> Problem | None:
    """What is wrong with a completion whatever was asked for; None where it may be looked into."""
    if completion.finish == "huge" or len(completion.text) > MOST:
        return problem("huge", f"more than {MOST} characters", completion)
    if completion.finish in REFUSED:
        return problem("refusal", f"the model refused ({completion.finish})", completion)
    if not completion.text.strip():
        return problem("empty", "no text", completion)
    return None


def parsed(completion: Completion, schema: type[BaseModel]) -> tuple[Any, bool] | Problem:
    """The object that a completion holds and whether its syntax had to be mended, or why there is none."""
    from pydantic import ValidationError

    found = unfit(completion)
    if found is not None:
        return found
    text, whole = json_object(completion.text)
    if not text:
        refused = completion.text.strip().lower().replace("\u2019", "'").startswith(_REFUSALS)
        kind: Kind = "refusal" if refused else "malformed"
        return problem(kind, "no JSON object", completion)
    if not whole:
        return problem("truncated", f"the JSON object does not end (finish: {completion.finish})", completion)
    try:
        values, repaired = _loaded(text)
        return schema.model_validate(values), repaired
    except ValidationError as error:
        first = error.errors(include_url=False, include_input=False)[0]
        place = ".".join(str(part) for part in first["loc"]) or "the object"
        return problem("schema", f"{place}: {first['msg']}", completion)
    except (ValueError, RecursionError) as error:
        return problem("malformed", str(error)[:200] or type(error).__name__, completion)


def json_object(text: str) -> tuple[str, bool]:
    """The first {...} in a text, and whether it ends; braces in strings do not count. Empty where there is none."""
    begin = text.find("{")
    if begin < 0:
        return "", False
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


def _loaded(text: str) -> tuple[Any, bool]:
    """The object, and whether slips of its syntax were mended: quotes, commas and the like, never anything it says.

    Raises ValueError where it cannot be read so.
    """
    try:
        return json.loads(text), False
    except ValueError as error:
        from json_repair import repair_json

        mended = repair_json(text, return_objects=True)
        if not isinstance(mended, dict) or _said(text) != _said("".join(_leaves(mended))):
            raise error
        return mended, True


def _said(text: str) -> str:
    """A text without JSON's syntax."""
    return _SYNTAX.sub("", text)


def _leaves(value: Any) -> Iterator[str]:
    """Keys and values in their order, as text."""
    if isinstance(value, dict):
        for name, inner in value.items():
            yield str(name)
            yield from _leaves(inner)
    elif isinstance(value, list):
        for inner in value:
            yield from _leaves(inner)
    else:
        yield value if isinstance(value, str) else json.dumps(value)
