# SPDX-License-Identifier: Apache-2.0
"""Generation of JSON that matches a schema, for a model that can only choose between pieces of text."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from typing import Any

from wiw.errors import ArgumentError

Choose = Callable[[str, Sequence[str]], int]
"""Given the text so far and several continuations, returns the index of one of them."""
PHRASES = ("the way ahead is clear", "something is in the way", "it is on the left", "it is on the right")
MAX_ITEMS = 8
"""Most items of an array whose schema has no limit."""
MAX_INTEGERS = 1000
"""Maximum number of values that are enumerated from an integer's minimum."""


def generate_instance(schema: Mapping[str, Any], choose: Choose) -> str:
    """Generate JSON text that matches a schema: objects, arrays, enums, constants, strings, numbers, booleans, null,
    unions.

    Raises:
        ArgumentError: a part of the schema is of another kind.
    """
    return _generate_value(schema, schema, "", choose)


def _generate_value(part: Mapping[str, Any], root: Mapping[str, Any], before: str, choose: Choose) -> str:
    """Generate the text of one value, which continues `before`."""
    if "$ref" in part:
        target: Any = root
        for name in str(part["$ref"]).removeprefix("#/").split("/"):
            target = target[name]
        return _generate_value(target, root, before, choose)
    options = part.get("anyOf") or part.get("oneOf")
    if options:
        names = [json.dumps(option, sort_keys=True) for option in options]
        return _generate_value(options[choose(before, names)], root, before, choose)
    kind = part.get("type")
    if kind == "integer" and "enum" not in part and "const" not in part:
        return _generate_integer(part, before, choose)
    if kind in ("object", "array"):
        return (_generate_object if kind == "object" else _generate_array)(part, root, before, choose)
    texts = _list_texts(part)
    return texts[choose(before, texts)]


def _list_texts(part: Mapping[str, Any]) -> list[str]:
    """List all texts of a value without parts."""
    if "const" in part or "enum" in part:
        return [json.dumps(value) for value in part.get("enum", [part.get("const")])]
    if part.get("type") in _SCALARS:
        return _SCALARS[part["type"]](part)
    raise ArgumentError(f"schema: expected an object, array, enum, union or scalar, got {json.dumps(part)[:200]}")


def _generate_object(part: Mapping[str, Any], root: Mapping[str, Any], before: str, choose: Choose) -> str:
    text = "{"
    for name, inner in part.get("properties", {}).items():
        text += f"{', ' if len(text) > 1 else ''}{json.dumps(name)}: "
        text += _generate_value(inner, root, before + text, choose)
    return text + "}"


def _generate_array(part: Mapping[str, Any], root: Mapping[str, Any], before: str, choose: Choose) -> str:
    least = int(part.get("minItems", 0))
    most = int(part.get("maxItems", max(least, MAX_ITEMS)))
    text, count = "[", 0
    while count < most and (count < least or choose(before + text, ["]", "," if count else "["]) == 1):
        text += ", " if count else ""
        text += _generate_value(part.get("items", {"type": "null"}), root, before + text, choose)
        count += 1
    return text + "]"


def _list_strings(part: Mapping[str, Any]) -> list[str]:
    most = int(part.get("maxLength", 1000))
    return [json.dumps(phrase[:most]) for phrase in PHRASES]


def _generate_integer(part: Mapping[str, Any], before: str, choose: Choose) -> str:
    """Generate an integer character by character, so that a wide range needs few options at once."""
    low = int(part.get("minimum", part.get("exclusiveMinimum", -1) + 1))
    high = int(part.get("maximum", part.get("exclusiveMaximum", low + 10) - 1))
    whole = [str(value) for value in range(low, min(high, low + MAX_INTEGERS) + 1)]
    text = ""
    while True:
        begun = [value for value in whole if value.startswith(text)]
        options = sorted({value[len(text) : len(text) + 1] for value in begun})
        found = options[choose(before + text, options)] if len(options) > 1 else options[0]
        if not found:
            return text
        text += found


def _list_numbers(part: Mapping[str, Any]) -> list[str]:
    low = float(part.get("minimum", 0.0))
    high = float(part.get("maximum", low + 1.0))
    return [json.dumps(low + (high - low) * step / 10) for step in range(11)]


_SCALARS: dict[Any, Callable[[Mapping[str, Any]], list[str]]] = {
    "string": _list_strings,
    "number": _list_numbers,
    "boolean": lambda _: ["true", "false"],
    "null": lambda _: ["null"],
}
