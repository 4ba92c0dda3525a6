# SPDX-License-Identifier: Apache-2.0
"""Parse numbers on the command line, with a plain message for anything that is not a number."""

from __future__ import annotations

from types import NoneType, UnionType
from typing import Any, Union, get_args, get_origin

from tyro.constructors import ConstructorRegistry, PrimitiveConstructorSpec, PrimitiveTypeInfo

NOUNS = {int: "a whole number", float: "a number"}


def make_registry() -> ConstructorRegistry:
    """Return the coercion rules of the commands for `int`, `float` and pairs of `int`, and their optional forms."""
    registry = ConstructorRegistry()
    registry.primitive_rule(_read_number)
    registry.primitive_rule(_read_pair)
    return registry


def _read_number(info: PrimitiveTypeInfo) -> PrimitiveConstructorSpec[Any] | None:
    kinds = _split_union(info.type)
    kind = next(iter(kinds - {NoneType}), None) if len(kinds - {NoneType}) == 1 else None
    if kind not in NOUNS:
        return None

    def parse(words: list[str]) -> Any:
        if words == ["None"] and NoneType in kinds:
            return None
        try:
            return kind(words[0])
        except ValueError:
            raise ValueError(f"expected {NOUNS[kind]}, got '{words[0]}'") from None

    return PrimitiveConstructorSpec(
        nargs=1,
        metavar="N",
        instance_from_str=parse,
        is_instance=lambda value: type(value) in kinds or (kind is float and type(value) is int),
        str_from_instance=lambda value: [str(value)],
    )


def _read_pair(info: PrimitiveTypeInfo) -> PrimitiveConstructorSpec[Any] | None:
    kinds = _split_union(info.type)
    if kinds - {NoneType} != {tuple[int, int]}:
        return None

    def parse(words: list[str]) -> Any:
        try:
            return int(words[0]), int(words[1])
        except ValueError:
            raise ValueError(f"expected two whole numbers, got '{' '.join(words)}'") from None

    return PrimitiveConstructorSpec(
        nargs=2,
        metavar="N N",
        instance_from_str=parse,
        is_instance=lambda value: (
            value is None if type(value) is not tuple else [type(number) for number in value] == [int, int]
        ),
        str_from_instance=lambda value: [str(number) for number in value or ("None", "None")],
    )


def _split_union(kind: Any) -> set[Any]:
    return set(get_args(kind)) if get_origin(kind) in (Union, UnionType) else {kind}


def parse_numbers(text: str | None, kind: type[int | float], name: str) -> list[Any] | None:
    """Return the numbers of an option such as "1,2,4"; None if it is not given.

    Raises:
        ArgumentError: something in it is not a number.
    """
    from wiw.errors import ArgumentError

    if text is None:
        return None
    try:
        return [kind(part) for part in text.split(",") if part.strip()]
    except ValueError:
        raise ArgumentError(f"--{name}: expected numbers as in 1,2,4, got '{text}'") from None
