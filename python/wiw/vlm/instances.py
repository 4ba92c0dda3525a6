# SPDX-License-Identifier: Apache-2.0
"""Generation of JSON that matches a schema: a model chooses between pieces of text, and writes the free strings."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from wiw.errors import ArgumentError

Choose = Callable[[str, Sequence[Sequence[str]]], int]
"""Given the text so far and several options, returns the index of one of them. An option is the texts with one of which
it goes on: a value as a whole, or the first characters of the values of a type."""
Write = Callable[[str, int, int | None], str]
"""Given the text before a string's opening quote, and the least and most characters (None: no limit), returns the
string's content, without quotes and escapes."""
MAX_ITEMS = 8
"""Most items of an array whose schema has no limit."""
MAX_INTEGERS = 1000
"""Maximum number of values that are enumerated from an integer's minimum."""


def generate_instance(schema: Mapping[str, Any], choose: Choose, write: Write) -> str:
    """Generate JSON text that matches a schema: objects, arrays, enums, constants, strings, numbers, booleans, null,
    unions. Of a string's constraints it heeds the length.

    Raises:
        ArgumentError: a part of the schema is of another kind.
    """
    return _Generator(schema, choose, write).generate_value(schema, "")


@dataclass(frozen=True)
class _Generator:
    """Generates the values of one schema; each method returns a value's text, which continues `before`."""

    root: Mapping[str, Any]
    choose: Choose
    write: Write

    def generate_value(self, part: Mapping[str, Any], before: str) -> str:
        if "$ref" in part:
            return self.generate_value(self._resolve(part), before)
        options = _list_alternatives(part)
        if options:
            chosen = self.choose(before, [self._list_openings(option) for option in options])
            return self.generate_value(options[chosen], before)
        kind = None if "enum" in part or "const" in part else part.get("type")
        generators: dict[Any, Callable[[Mapping[str, Any], str], str]] = {
            "object": self._generate_object,
            "array": self._generate_array,
            "string": self._generate_string,
            "integer": self._generate_integer,
        }
        return generators.get(kind, self._choose_text)(part, before)

    def _resolve(self, part: Mapping[str, Any]) -> Mapping[str, Any]:
        target: Any = self.root
        for name in str(part["$ref"]).removeprefix("#/").split("/"):
            target = target[name]
        return dict(target)

    def _list_openings(self, part: Mapping[str, Any]) -> list[str]:
        """List texts with one of which each value of a part begins, and as few of them as tell it from other types."""
        if "$ref" in part:
            return self._list_openings(self._resolve(part))
        options = _list_alternatives(part)
        if options:
            return sorted({opening for option in options for opening in self._list_openings(option)})
        kind = None if "enum" in part or "const" in part else part.get("type")
        if kind in ("object", "array", "string"):
            return [_begin_object(part) if kind == "object" else "[" if kind == "array" else '"']
        texts = _list_integers(part) if kind == "integer" else _list_texts(part)
        return sorted({text if text in ("null", "true", "false") else text[0] for text in texts})

    def _choose_text(self, part: Mapping[str, Any], before: str) -> str:
        return self._choose_one(before, _list_texts(part))

    def _choose_one(self, before: str, texts: Sequence[str]) -> str:
        return texts[self.choose(before, [[text] for text in texts])]

    def _generate_string(self, part: Mapping[str, Any], before: str) -> str:
        most = part.get("maxLength")
        text = self.write(before, int(part.get("minLength", 0)), None if most is None else int(most))
        return json.dumps(text, ensure_ascii=False)

    def _generate_object(self, part: Mapping[str, Any], before: str) -> str:
        text = "{"
        for name, inner in part.get("properties", {}).items():
            text += f"{', ' if len(text) > 1 else ''}{json.dumps(name)}: "
            text += self.generate_value(inner, before + text)
        return text + "}"

    def _generate_array(self, part: Mapping[str, Any], before: str) -> str:
        items = part.get("items", {"type": "null"})
        least = int(part.get("minItems", 0))
        most = int(part.get("maxItems", max(least, MAX_ITEMS)))
        text, count = "[", 0
        while count < most and (
            count < least or self.choose(before + text, [["]"], [","] if count else self._list_openings(items)]) == 1
        ):
            text += ", " if count else ""
            text += self.generate_value(items, before + text)
            count += 1
        return text + "]"

    def _generate_integer(self, part: Mapping[str, Any], before: str) -> str:
        """Generate an integer character by character, so that a wide range needs few options at once."""
        whole, text = _list_integers(part), ""
        while True:
            begun = [value for value in whole if value.startswith(text)]
            options = sorted({value[len(text) : len(text) + 1] for value in begun})
            found = self._choose_one(before + text, options) if len(options) > 1 else options[0]
            if not found:
                return text
            text += found


def _list_alternatives(part: Mapping[str, Any]) -> Sequence[Mapping[str, Any]]:
    """Return the parts of a union; none for another part."""
    return part.get("anyOf") or part.get("oneOf") or ()


def _begin_object(part: Mapping[str, Any]) -> str:
    """Return an object's text as far as its first name, which tells it from other objects."""
    return "{" + "".join(json.dumps(name) for name in list(part.get("properties", ()))[:1])


def _list_texts(part: Mapping[str, Any]) -> list[str]:
    """List all texts of a value without parts."""
    if "const" in part or "enum" in part:
        return [json.dumps(value) for value in part.get("enum", [part.get("const")])]
    if part.get("type") in _SCALARS:
        return _SCALARS[part["type"]](part)
    raise ArgumentError(f"schema: expected an object, array, enum, union or scalar, got {json.dumps(part)[:200]}")


def _list_integers(part: Mapping[str, Any]) -> list[str]:
    low = int(part.get("minimum", part.get("exclusiveMinimum", -1) + 1))
    high = int(part.get("maximum", part.get("exclusiveMaximum", low + 10) - 1))
    return [str(value) for value in range(low, min(high, low + MAX_INTEGERS) + 1)]


def _list_numbers(part: Mapping[str, Any]) -> list[str]:
    low = float(part.get("minimum", 0.0))
    high = float(part.get("maximum", low + 1.0))
    return [json.dumps(low + (high - low) * step / 10) for step in range(11)]


_SCALARS: dict[Any, Callable[[Mapping[str, Any]], list[str]]] = {
    "number": _list_numbers,
    "boolean": lambda _: ["true", "false"],
    "null": lambda _: ["null"],
}
