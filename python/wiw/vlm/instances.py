# SPDX-License-Identifier: Apache-2.0
"""JSON that fits a schema, made by someone who only ever chooses between pieces of text."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from typing import Any

from wiw.errors import ArgumentError

Choose = Callable[[str, Sequence[str]], int]
"""Given the text so far and several ways to go on, the index of one of them."""
PHRASES = ("the way ahead is clear", "something is in the way", "it is on the left", "it is on the right")
MOST_ITEMS = 8
"""Of an array whose schema names no limit."""
MOST_NUMBERS = 1000
"""From the least that a whole number may be."""


def instance(schema: Mapping[str, Any], choose: Choose) -> str:
    """JSON text that fits a schema: objects, arrays, enums, constants, strings, numbers, booleans, null, unions.

    Raises:
        ArgumentError: a part of the schema is of another kind.
    """
    return _value(schema, schema, "", choose)


def _value(part: Mapping[str, Any], root: Mapping[str, Any], before: str, choose: Choose) -> str:
    """The text of one value, which goes on after `before`."""
    if "$ref" in part:
        target: Any = root
        for name in str(part["$ref"]).removeprefix("#/").split("/"):
            target = target[name]
        return _value(target, root, before, choose)
    options = part.get("anyOf") or part.get("oneOf")
    if options:
        names = [json.dumps(option, sort_keys=True) for option in options]
        return _value(options[choose(before, names)], root, before, choose)
    kind = part.get("type")
    if kind == "integer" and "enum" not in part and "const" not in part:
        return _integer(part, before, choose)
    if kind in ("object", "array"):
        return (_object if kind == "object" else _array)(part, root, before, choose)
    texts = _texts(part)
    return texts[choose(before, texts)]


def _texts(part: Mapping[str, Any]) -> list[str]:
    """All that a value without parts may be."""
    if "const" in part or "enum" in part:
        return [json.dumps(value) for value in part.get("enum", [part.get("const")])]
    if part.get("type") in _SCALARS:
        return _SCALARS[part["type"]](part)
    raise ArgumentError(f"schema: expected an object, array, enum, union or scalar, got {json.dumps(part)[:200]}")


def _object(part: Mapping[str, Any], root: Mapping[str, Any], before: str, choose: Choose) -> str:
    text = "{"
    for name, inner in part.get("properties", {}).items():
        text += f"{', ' if len(text) > 1 else ''}{json.dumps(name)}: "
        text += _value(inner, root, before + text, choose)
    return text + "}"


def _array(part: Mapping[str, Any], root: Mapping[str, Any], before: str, choose: Choose) -> str:
    least = int(part.get("minItems", 0))
    most = int(part.get("maxItems", max(least, MOST_ITEMS)))
    text, count = "[", 0
    while count < most and (count < least or choose(before + text, ["]", "," if count else "["]) == 1):
        text += ", " if count else ""
        text += _value(part.get("items", {"type": "null"}), root, before + text, choose)
        count += 1
    return text + "]"


def _strings(part: Mapping[str, Any]) -> list[str]:
    most = int(part.get("maxLength", 1000))
    return [json.dumps(phrase[:most]) for phrase in PHRASES]


def _integer(part: Mapping[str, Any], before: str, choose: Choose) -> str:
    """Written character by character, so that a wide range is not many ways at once."""
    low = int(part.get("minimum", part.get("exclusiveMinimum", -1) + 1))
    high = int(part.get("maximum", part.get("exclusiveMaximum", low + 10) - 1))
    whole = [str(value) for value in range(low, min(high, low + MOST_NUMBERS) + 1)]
    text = ""
    while True:
        begun = [value for value in whole if value.startswith(text)]
        options = sorted({value[len(text) : len(text) + 1] for value in begun})
        found = options[choose(before + text, options)] if len(options) > 1 else options[0]
        if not found:
            return text
        text += found


def _numbers(part: Mapping[str, Any]) -> list[str]:
    low = float(part.get("minimum", 0.0))
    high = float(part.get("maximum", low + 1.0))
    return [json.dumps(low + (high - low) * step / 10) for step in range(11)]


_SCALARS: dict[Any, Callable[[Mapping[str, Any]], list[str]]] = {
    "string": _strings,
    "number": _numbers,
    "boolean": lambda _: ["true", "false"],
    "null": lambda _: ["null"],
}
