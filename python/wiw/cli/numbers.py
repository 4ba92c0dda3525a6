# SPDX-License-Identifier: Apache-2.0
"""Parse numbers on the command line, with a plain message for anything that is not a number."""

from __future__ import annotations

from types import NoneType, UnionType
from typing import Any, Union, get_args, get_origin

from tyro.constructors import ConstructorRegistry, PrimitiveConstructorSpec, PrimitiveTypeInfo

NOUNS = {int: "a whole number", float: "a number", tuple[int, int]: "two whole numbers"}


def make_registry() -> ConstructorRegistry:
    """Return the coercion rule of the commands for `int`, `float` and pairs of `int`, and their optional forms."""
    registry = ConstructorRegistry()
    registry.primitive_rule(_read_numbers)
    return registry


def _read_numbers(info: PrimitiveTypeInfo) -> PrimitiveConstructorSpec[Any] | None:
    kinds = set(get_args(info.type)) if get_origin(info.type) in (Union, UnionType) else {info.type}
    kind = next(iter(kinds - {NoneType}), None) if len(kinds - {NoneType}) == 1 else None
    if kind not in NOUNS:
        return None
    parts = get_args(kind) or (kind,)

    def parse(words: list[str]) -> Any:
        if words == ["None"] and NoneType in kinds:
            return None
        try:
            numbers = tuple(part(word) for part, word in zip(parts, words, strict=True))
        except ValueError:
            raise ValueError(f"expected {NOUNS[kind]}, got '{' '.join(words)}'") from None
        return numbers if len(parts) > 1 else numbers[0]

    def is_instance(value: Any) -> bool:
        if value is None:
            return NoneType in kinds
        types = tuple(map(type, value)) if len(parts) > 1 and type(value) is tuple else (type(value),)
        return types == parts or (kind is float and types == (int,))

    return PrimitiveConstructorSpec(
        nargs=len(parts),
        metavar=" ".join("N" * len(parts)),
        instance_from_str=parse,
        is_instance=is_instance,
        str_from_instance=lambda value: [
            str(each) for each in (value if type(value) is tuple else [value] * len(parts))
        ],
    )


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
