# SPDX-License-Identifier: Apache-2.0
"""Values that users give by name, in YAML or as options, held to the types that a dataclass declares for them."""

from __future__ import annotations

import re
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import fields
from pathlib import Path
from types import NoneType, UnionType
from typing import Any, Literal, Union, get_args, get_origin, get_type_hints

import numpy as np

from wiw.errors import ArgumentError
from wiw.suggestions import did_you_mean

_SCIENTIFIC = re.compile(r"[+-]?\d+(\.\d*)?[eE][+-]?\d+")
"""Numbers that YAML takes for text, such as 1e-5."""
_NAMES = {
    int: "a whole number",
    float: "a number",
    bool: "true or false",
    str: "text",
    Path: "a path",
    NoneType: "null",
}


def read_values(declared: type, values: Mapping[str, Any], where: str, noun: str = "name") -> dict[str, Any]:
    """Return values in the types that a dataclass declares for the fields of their names.

    Where it declares a float, whole numbers become one, and so does text such as 1e-5; lists become tuples where it
    declares these. Paths may be text.

    Args:
        declared: the dataclass.
        values: by name.
        where: the place of the values, for messages.
        noun: for a name among them, such as "option".

    Raises:
        ArgumentError: a name that is not a field, or a value of another type; says where, and what is expected.
    """
    require_known(values, [field.name for field in fields(declared)], where, noun)
    kinds = get_type_hints(declared)
    return {name: _read_value(value, kinds[name], f"{where}: {name}") for name, value in values.items()}


def require_types(where: str, settings: Any) -> None:
    """Check that the fields of a dataclass have the types that it declares; numpy's numbers become Python's.

    Raises:
        ArgumentError: one has another type; says where, which, and what is expected.
    """
    for name, value in vars(settings).items():
        if isinstance(value, np.generic):
            object.__setattr__(settings, name, value.item())  # of a frozen one, too
    read_values(type(settings), vars(settings), where)


def require_positive(where: str, settings: object, *names: str) -> None:
    """Check that the settings of these names are 1 or more; of a tuple each number counts.

    Raises:
        ArgumentError: one is not; says where, which, and its value.
    """
    for name in names:
        value = getattr(settings, name)
        if min(value if isinstance(value, tuple) else (value,)) < 1:
            raise ArgumentError(f"{where}: {name} must be positive, got {value}")


def require_known(names: Iterable[Any], known: Collection[str], where: str, noun: str = "name") -> None:
    """Check that all names are known.

    Raises:
        ArgumentError: some are not; says where, what is like the first of them, and what there is.
    """
    unknown = [str(name) for name in names if name not in known]
    if unknown:
        there = [str(name) for name in known]  # YAML reads 1 as a number, as a name too
        hint = did_you_mean(unknown[0], there)
        expected = ", ".join(there) or "none"
        raise ArgumentError(f"{where}: unknown {noun} '{unknown[0]}'; expected one of {expected}.{hint}")


def _read_value(value: Any, kind: Any, where: str) -> Any:
    try:
        return _convert_value(value, kind)
    except TypeError:
        raise ArgumentError(f"{where}: expected {_describe_type(kind)}, got {value!r}") from None


def _convert_value(value: Any, kind: Any) -> Any:
    """Return a value in a type.

    Raises:
        TypeError: it is of another one.
    """
    origin, inner = get_origin(kind), get_args(kind)
    if origin in (Union, UnionType):
        return _convert_to_one(value, inner)
    if kind is float:
        return _convert_number(value)
    if origin is tuple:
        return _convert_tuple(value, inner)
    if origin is Literal:
        fits = any(value == each and type(value) is type(each) for each in inner)
    elif origin is Sequence:
        fits = isinstance(value, Sequence) and not isinstance(value, str)
    elif kind is int:
        fits = isinstance(value, int) and not isinstance(value, bool)
    else:
        fits = kind is Any or isinstance(value, (str, Path) if kind is Path else origin or kind)
    if not fits:
        raise TypeError
    return value


def _convert_to_one(value: Any, kinds: Sequence[Any]) -> Any:
    for kind in kinds:
        try:
            return _convert_value(value, kind)
        except TypeError:
            continue
    raise TypeError


def _convert_number(value: Any) -> float:
    is_number = isinstance(value, int | float) and not isinstance(value, bool)
    if not is_number and not (isinstance(value, str) and _SCIENTIFIC.fullmatch(value)):
        raise TypeError
    try:
        return float(value)
    except OverflowError:
        raise TypeError from None


def _convert_tuple(value: Any, kinds: Sequence[Any]) -> tuple[Any, ...]:
    if not isinstance(value, list | tuple):
        raise TypeError
    each = [kinds[0]] * len(value) if kinds[1:] == (...,) else kinds
    if len(value) != len(each):
        raise TypeError
    return tuple(_convert_value(item, kind) for item, kind in zip(value, each, strict=True))


def _describe_type(kind: Any) -> str:
    """Return a type in words."""
    origin, inner = get_origin(kind), get_args(kind)
    if origin in (Union, UnionType):
        return " or ".join(dict.fromkeys(_describe_type(each) for each in inner))
    if origin is Literal:
        return f"{'one of ' if len(inner) > 1 else ''}{', '.join(map(str, inner))}"
    if origin is tuple:
        return f"[{', '.join('...' if each is ... else _describe_type(each) for each in inner)}]"
    if origin in (Sequence, list):
        return f"a list, each {_describe_type(inner[0])}"
    if origin in (Mapping, dict):
        return "`name: value` lines"
    return _NAMES.get(kind, getattr(kind, "__name__", str(kind)))
